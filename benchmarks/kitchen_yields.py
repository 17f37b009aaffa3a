"""Yields of the kitchen's scripts: of so many seeds a task, how many the Panda solves; CPU time of a pair and a step.

The file that is written after every task is also where a killed run goes on: the same command plays what is missing.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco
from benchmarks.report import Report, Row, lines_of, spread
from dual_system.analysis.markdown import percent
from dual_system.analysis.statistics import wilson
from dual_system.data.kitchen import PairJob, record
from dual_system.tasks.engine import Status
from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.environment import IMAGE_PX, KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.seeds import scenes
from dual_system.tasks.task import TaskError
from protocol import files
from protocol.command_line import command, flat, parse
from protocol.errors import CommandError
from sim_client.ledger import write_json

Yield = dict[str, Any]  # what is known of one task
_WARM_UP_STEPS, _TIMED_STEPS = 20, 100  # with pictures, in a scene


@dataclass(frozen=True, slots=True, kw_only=True)
class YieldOptions:
    """Plays the scripts of the kitchen's tasks and prints how many seeds each solves."""

    out: Path
    """JSON file of what is found; the same command goes on with one that a killed run has left."""
    tasks: tuple[str, ...] = ()
    """Names of tasks or of goal sets. Empty: the twenty-four tasks."""
    goal_sets: bool = False
    """Play the goal sets as well, in each scene the goal that its seed draws."""
    seeds: int = 100
    """Number of scenes a task."""
    split: Literal["demo", "development"] = "demo"
    """Split of the scenes. demo: the objects' instances A, which are trained on; development: those held out, B."""
    pairs: int = 2
    """Number of solved scenes a task also played with pictures and collected as a pair, for their CPU time."""
    report: bool = False
    """Write the table to benchmarks/reports as well, for `benchmarks.render`; on a machine that does nothing else."""

    def names(self) -> tuple[str, ...]:
        """Returns what is played, each once. Raises TaskError for an unknown name."""
        if unknown := [name for name in self.tasks if name not in TASKS and name not in GOAL_SETS]:
            raise TaskError(f"unknown kitchen task {unknown[0]!r}; expected {', '.join([*TASKS, *GOAL_SETS])}")
        return tuple(dict.fromkeys([*(self.tasks or TASKS), *(GOAL_SETS if self.goal_sets else ())]))


def played(name: str, seeds: range, num_pairs: int) -> Yield:
    """Plays a task's scenes; returns its successes, steps and CPU seconds, and why the others failed, by seed."""
    steps, cpu_s, failed = [], [], {}
    with KitchenEnvironment(name, render=False) as environment:
        for seed in seeds:
            start_s = time.process_time()
            why_not, num_steps = outcome(environment, seed)
            cpu_s.append(time.process_time() - start_s)
            steps.append(num_steps)
            if why_not:
                failed[str(seed)] = why_not
    solved = [seed for seed in seeds if str(seed) not in failed]
    return {
        "seeds": [seeds[0], seeds[-1]],
        "solved": len(solved),
        "failed": failed,
        "steps": steps,
        "cpu_s": round(sum(cpu_s) / len(cpu_s), 2),
        "pair_cpu_s": [collected_s(name, seed) for seed in solved[:num_pairs]],
        "step_cpu_ms": [cpu_ms for seed in solved[:num_pairs] for cpu_ms in stepped_ms(name, seed)],
    }


def outcome(environment: KitchenEnvironment, seed: int) -> tuple[str, int]:
    """Plays one seed's script; returns why it failed, or "", and its number of steps."""
    last = environment.reset(seed)
    for action in environment.oracle():
        last = environment.step(action, look=False)
        if last.status is not Status.ONGOING:
            break
    if last.status is Status.SUCCESS:
        return "", last.step
    return last.reason or "the script ended, or the arm could not reach", last.step


def collected_s(name: str, seed: int) -> float:
    """Returns the CPU seconds of a pair as ``pp-collect kitchen`` makes it: rehearsal, demonstration and execution."""
    job = PairJob(task=name, slot=0, image_px=IMAGE_PX, demonstration_hz=1, invocation_hz=20)
    with KitchenEnvironment(name) as environment:
        start_s = time.process_time()
        record(environment, job, seed)
        return round(time.process_time() - start_s, 2)


def stepped_ms(name: str, seed: int) -> list[float]:
    """Returns the CPU milliseconds of a scene's steps with three pictures each; the first ones warm up."""
    cpu_ms: list[float] = []
    with KitchenEnvironment(name) as environment:
        environment.reset(seed)
        for action in environment.oracle():
            start_s = time.process_time()
            now = environment.step(action)
            cpu_ms.append(round(1e3 * (time.process_time() - start_s), 2))
            if now.status is not Status.ONGOING or len(cpu_ms) == _WARM_UP_STEPS + _TIMED_STEPS:
                break
    return cpu_ms[_WARM_UP_STEPS:]


def table(found: dict[str, Yield]) -> list[Row]:
    """Returns a row a task, in the order in which they were played."""
    rows: list[Row] = []
    for name, task in found.items():
        num, pairs_s, steps_ms = len(task["steps"]), task["pair_cpu_s"], task["step_cpu_ms"]
        rows.append(
            {
                "task": name,
                "successes": f"{task['solved']}/{num}",
                "success, % [95 %]": percent(wilson(task["solved"] / num, num)),
                "longest, steps": max(task["steps"]),
                "script, CPU s": task["cpu_s"],
                "pair, CPU s": round(median(pairs_s), 1) if pairs_s else None,
                **spread(steps_ms, "step_cpu_ms"),
            }
        )
    return rows


def begun(options: YieldOptions) -> dict[str, Any]:
    """Returns what a file holds already. Raises CommandError if it was begun with other scenes."""
    asked = {name: flat(options)[name] for name in ("seeds", "split", "pairs")}
    if not options.out.exists():
        return {"config": asked, "tasks": {}}
    kind = "file of kitchen_yields"
    there = files.read_json(options.out, kind)
    with files.reading(options.out, kind):
        config = dict(there["config"])
    if config != asked:
        raise CommandError(f"{options.out} was begun with {config}, and this is {asked}; give another --out")
    return dict(there)


@command("kitchen-yields")
def main(argv: list[str] | None = None) -> int:
    options = parse(YieldOptions, argv, prog="kitchen-yields")
    names, seeds = options.names(), scenes(options.seeds, split=options.split)
    report = Report(
        name="kitchen_yields",
        question="How often do the kitchen's scripts reach their goals, and what do a pair and a step cost?",
        config=options,
        warm_up=f"the first {_WARM_UP_STEPS} steps of a scene.",
    )
    state = begun(options)
    for name in names:
        if name not in state["tasks"]:
            state["tasks"][name] = played(name, seeds, options.pairs)
            files.folder(options.out.parent)
            write_json(options.out, state)
    found = {name: state["tasks"][name] for name in names}
    rows = table(found)
    print("\n".join(lines_of(rows)))
    if options.report:
        report.add_table("A step has three pictures of 128 px, rendered in software", rows)
        report.write()
    for name, task in found.items():
        for reason, count in Counter(task["failed"].values()).items():
            where = ", ".join(seed for seed, why in task["failed"].items() if why == reason)
            print(f"- {name}, {count} failed: {reason} (seeds {where})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
