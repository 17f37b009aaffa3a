"""``pp-eval``: the paper's evaluation (B.1) of one condition: every task, the same scenes in several runs.

An evaluation is a set of independent episodes. A worker that has loaded its servers once plays each in lockstep, and
its result is written as soon as it ends (`Ledger`). The same command resumes a killed evaluation: no episode is played
twice or lost, and ``results.json`` equals that of an undisturbed evaluation.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections import Counter
from collections.abc import Iterable
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from dual_system.data.workers import LocalWorkers, RayWorkers, Workers, worker_index
from protocol import messages as m
from protocol.bus import Bus
from protocol.command_line import command, parse
from protocol.link import Link
from protocol.logs import set_up_logging
from protocol.version import versions
from sim_client.condition import EvalOptions, EvaluationError, Job
from sim_client.harness import BuildServer, ServerStep, open_harness
from sim_client.launch import Daemons
from sim_client.ledger import Ledger, write_json
from sim_client.null_ponder import NullPonder, cognition_shape, hears_ponder
from sim_client.suite import Suite
from sim_client.swapped_ponder import SwappedPonder
from sim_client.telling_ponder import FAR_PX, TellingPonder
from sim_client.worlds import World, open_world

DONE, REFUSED, INTERRUPTED = 0, 2, 130
Line = dict[str, Any]  # one episode's entry in results.json

_HOW_MANY = ("tasks", "episodes", "runs")  # a folder may be given more of them later
_HOW = ("out", "patience_s", "progress")  # and these change no result


@command("pp-eval")
def main(argv: list[str] | None = None) -> int:
    set_up_logging("WARNING")
    try:
        options = parse(EvalOptions, argv, prog="pp-eval")
        episodes = evaluate(options, _workers(options))["episodes"]
    except KeyboardInterrupt:
        sys.stderr.write("pp-eval: interrupted; finished episodes are kept, the same command resumes\n")
        return INTERRUPTED
    all_played = [episode for episode in episodes if "unpaired" not in episode]
    for task in sorted({episode["task"] for episode in episodes}):
        played = [episode for episode in all_played if episode["task"] == task]
        unpaired = sum(episode["task"] == task for episode in episodes) - len(played)
        left_out = f" ({unpaired} more have no demonstration)" if unpaired else ""
        sys.stdout.write(f"{task}: {sum(e['success'] for e in played)} of {len(played)}{left_out}\n")
    broken_off = Counter(each["reason"] for each in all_played if each["status"] == m.TaskStatus.ABORTED.name)
    for reason, number in broken_off.most_common():
        sys.stdout.write(f"{number} broken off: {reason}\n")
    folder = shlex.quote(str(options.out))
    sys.stdout.write(f"{options.out / 'results.json'}; tables: pp-tables {folder} --out {folder}\n")
    return DONE


def evaluate(options: EvalOptions, workers: Workers[Job, Line]) -> dict[str, Any]:
    """Plays the missing episodes; returns the contents of ``results.json``, over everything in the folder.

    Whatever is raised, finished episodes are kept.

    Raises:
        EvaluationError: an episode could not be started.
        LedgerError: the folder holds another condition, or another process works in it.
        DatasetError: workers keep dying, or there is no Ray.
        TaskError, DonorError, TransportError: before or at the first episode; see there.
    """
    jobs = options.jobs()
    common = {name: value for name, value in options.config().items() if name not in (*_HOW_MANY, *_HOW)}
    with Ledger(options.out, common | {"versions": versions()}) as ledger:
        missing = [job for job in jobs if job.key not in ledger.lines]
        bar = tqdm(total=len(jobs), initial=len(jobs) - len(missing), unit="episode", disable=not options.log.progress)
        try:
            for job, line in workers.run(missing):
                ledger.commit(job.key, line)
                bar.update()
        finally:
            bar.close()
            results = {
                "config": options.config(),
                "versions": versions(),
                "episodes": _in_order(ledger.lines.values()),
            }
            write_json(options.out / "results.json", results)
    return results


def _in_order(lines: Iterable[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: (line["task"], line["run"], line["seed"]))


def play(job: Job) -> Line:
    """Plays one episode in this process.

    Raises:
        EvaluationError: it did not start, because servers do not fit, refuse or died. That is no result of the policy;
            the same command tries again. Whatever ends an episode later is its result.
    """
    return _harness(job.options).play(job)


@cache
def _harness(options: EvalOptions) -> EvaluationHarness:
    """Returns this process's harness, with its servers loaded; it lasts as long as the process."""
    harness = EvaluationHarness(options)
    Finalize(None, harness.close, exitpriority=0)  # a worker's end, while GL and other threads are still there
    return harness


class EvaluationHarness:
    """One worker's servers, and the scene of its current task."""

    def __init__(self, options: EvalOptions) -> None:
        sim = options.sim(worker_index())
        self._options = options
        self._donor: SwappedPonder | None = None
        self._open = contextlib.ExitStack()
        daemons = self._open.enter_context(Daemons(options.out / "servers" / str(os.getpid())))
        harness = open_harness(sim, daemons, self._replacement())
        self._open.callback(harness.bus.close)
        self._suite = Suite(sim, harness.link, harness.clock, daemons.dead)
        self._task = ""
        self._environment: World | None = None

    def play(self, job: Job) -> Line:
        """Like the function of this name."""
        if self._donor is not None and job.donor is not None:
            self._donor.load(job.donor)
        line = self._suite.play(self._scene(job.task), job.task, job.seed, run=job.run)
        is_begun = line["status"] != "ABORTED" or line["steps"] > 0 or "unpaired" in line
        if self._options.policy == "servers" and not is_begun:
            raise EvaluationError(f"{job.key} was not begun: {line['reason']}")
        if job.donor is not None:
            line["donor"] = job.donor.name
        return line

    def close(self) -> None:
        """Stops and frees everything; once more does nothing."""
        with self._open:
            if self._environment is not None:
                self._environment.close()
                self._environment = None

    def _scene(self, task: str) -> World:
        if self._environment is None or task != self._task:
            if self._environment is not None:
                self._environment.close()
            needs_frames = self._options.policy == "servers" or self._options.log.record  # the oracle alone needs none
            shown = self._options.condition
            self._environment = open_world(
                task, pictures=shown.pictures, max_steps=shown.max_steps, render=needs_frames
            )
            self._task = task
        return self._environment

    def _replacement(self) -> BuildServer | None:
        """Returns what replaces PONDER, or None if PONDER itself is queried."""
        options = self._options
        if options.condition.cognition == "other-episode":
            return self._build_donor
        if (told := options.condition.subgoal_text) != "ponder":
            kind = m.SubgoalKind.TASK_SIMPLE if told == "simple" else m.SubgoalKind.TASK_GROUNDED
            off_px = FAR_PX if told == "displaced" else 0.0
            return lambda bus, robot, _: TellingPonder(Link(bus, robot=robot, proc="ponder"), kind, off_px).step
        pounce = options.pounce_checkpoint
        if pounce is not None and options.workers.servers == "in-process" and not options.log.record:
            with contextlib.suppress(ValueError):  # a public folder does not hold K and H: PONDER has to be loaded
                shape = cognition_shape(pounce)
                is_deaf = options.ponder_checkpoint is None and not hears_ponder(pounce)
                if is_deaf or options.condition.cognition == "null":
                    return lambda bus, robot, _: NullPonder(Link(bus, robot=robot, proc="ponder"), *shape).step
        return None

    def _build_donor(self, bus: Bus, robot: str, checkpoint: Path | None) -> ServerStep:
        self._donor = SwappedPonder(Link(bus, robot=robot, proc="ponder"))
        return self._donor.step


def _workers(options: EvalOptions) -> Workers[Job, Line]:
    chosen = options.workers
    if chosen.ray is not None:
        return RayWorkers(chosen.ray, play, num_gpus=chosen.gpus_per_worker)
    return LocalWorkers(chosen.workers, play)


if __name__ == "__main__":
    sys.exit(main())
