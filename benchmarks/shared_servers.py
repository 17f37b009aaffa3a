"""The curve of `many_robots` by CPU time: what sharing costs where each server has a core, whatever else runs here.

The engines are real, time is virtual: it goes on by the CPU time that a forward took in this thread, and jumps to the
next request when none waits. Robots ask PONDER once a second and POUNCE twice, their phases evenly spread. Turns are
those of the servers: PONDER's engine has its own, POUNCE answers who was answered longest ago first. There is no bus,
no clock service and no gateway in it. A cognition is used as `clock.reference` says.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Report, Row, show, spread
from clock.reference import Ready, latest_ready
from ponder_server.__main__ import build_engine as build_ponder
from ponder_server.config import PonderOptions
from ponder_server.config import RobotsOptions as PonderRobots
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from pounce_server.__main__ import build_engine as build_pounce
from pounce_server.config import PounceOptions
from pounce_server.contract import example_request
from pounce_server.engine import EagerEngine
from protocol.command_line import parse

QUERY_NS, INVOKE_NS = 1_000_000_000, 500_000_000
MAX_ROWS = 8
WAYS = {"in common batches": MAX_ROWS, "one at a time": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedOptions:
    """The curve over robots."""

    robots: tuple[int, ...] = (1, 2, 4, 8, 16)
    queries: int = 64
    """Least number of queries of a row, of all robots together; the first second is not counted."""
    min_seconds: int = 8
    checkpoints: Path | None = Path("checkpoints/small")
    """Folder with ponder and pounce. None: the tiny pair with random weights."""


class Core:
    """One server's core: its time goes on by the CPU time of what runs on it."""

    def __init__(self) -> None:
        self.now_ns = 0

    def run(self, work: Callable[[], object]) -> object:
        start_ns = time.thread_time_ns()
        done = work()
        self.now_ns += time.thread_time_ns() - start_ns
        return done


Served = list[tuple[int, int, int]]
"""(robot, instant asked, instant answered) of every request, ns."""


def main(argv: list[str] | None = None) -> int:
    options = parse(SharedOptions, argv, prog="shared-servers")
    report = Report(
        name="shared_servers",
        question="How long do answers take, and how old is a cognition in use, when robots share one pair of servers?",
        config=options,
        warm_up="the engines' own, and the first second of each row.",
    )
    answers: list[Row] = []
    ages: list[Row] = []
    engines = {way: _engines(options, max_rows) for way, max_rows in WAYS.items()}
    for count in options.robots:
        seconds = max(options.min_seconds, -(-options.queries // count)) + 1
        for way, max_rows in WAYS.items():
            ponder, pounce = engines[way]
            thoughts = _ponder(ponder, count, seconds)
            chunks = _pounce(pounce, count, max_rows, seconds)
            head: Row = {"robots": count, "served": way}
            for of, served in (("POUNCE", chunks), ("PONDER", thoughts)):
                times_ms = [(done - asked) / 1e6 for _, asked, done in served if asked >= QUERY_NS]
                answers.append(head | {"of": of} | spread(times_ms, "ms"))
            ages.append(head | spread(_ages(thoughts, chunks), "ms"))
            print(*answers[-2:], ages[-1], sep="\n", flush=True)
    report.add_table("From a request to its answer", answers)
    report.add_table("Age of the cognition that an invocation uses", ages)
    report.notes += [
        "CPU time of one thread per server: what other programs of this machine take is not in it, but for the caches.",
        f"A robot asks PONDER every {QUERY_NS // 1_000_000} ms and POUNCE every {INVOKE_NS // 1_000_000} ms.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _due(count: int, period_ns: int, seconds: int) -> list[tuple[int, int]]:
    """(instant, robot) of all requests in their order, evenly spread."""
    num_each = seconds * 1_000_000_000 // period_ns
    return sorted(
        (number * period_ns + robot * period_ns // count, robot) for number in range(num_each) for robot in range(count)
    )


def _engines(options: SharedOptions, max_rows: int) -> tuple[QwenEngine, EagerEngine]:
    """Both models, warm."""
    folders = {proc: options.checkpoints / proc if options.checkpoints else None for proc in ("ponder", "pounce")}
    robots = PonderRobots(max_sessions=max(2, *options.robots), max_batch_rows=max_rows)
    ponder = build_ponder(PonderOptions(checkpoint=folders["ponder"], robots=robots))
    pounce = build_pounce(PounceOptions(checkpoint=folders["pounce"]))
    assert isinstance(ponder, QwenEngine)
    assert isinstance(pounce, EagerEngine)
    for engine in (ponder, pounce):
        engine.warm_up()
    return ponder, pounce


def _ponder(engine: QwenEngine, count: int, seconds: int) -> Served:
    frames = engine.example_frames()
    for robot in range(count):
        engine.open(str(robot), Opening(instruction="pick the cubes that were highlighted", demo_frames=()))
    due, core, asked, served = _due(count, QUERY_NS, seconds), Core(), dict[str, int](), Served()
    while due or asked:
        if not asked:
            core.now_ns = max(core.now_ns, due[0][0])
        for instant_ns, robot in [each for each in due if each[0] <= core.now_ns and str(each[1]) not in asked]:
            if str(robot) not in asked:  # a robot whose query is open asks later
                asked[str(robot)] = instant_ns
                due.remove((instant_ns, robot))
                proprio = np.zeros(8, np.float32)
                core.run(lambda robot=robot, proprio=proprio: engine.begin(str(robot), frames, proprio=proprio))  # type: ignore[misc]
        for outcome in core.run(engine.step):  # type: ignore[attr-defined]
            outcome.unwrap()
            served.append((int(outcome.session), asked.pop(outcome.session), core.now_ns))
    for robot in range(count):
        engine.close(str(robot))
    return served


def _pounce(engine: EagerEngine, count: int, max_rows: int, seconds: int) -> Served:
    requests = [example_request(engine.spec, seed=robot) for robot in range(count)]
    due, core, waiting, served = _due(count, INVOKE_NS, seconds), Core(), dict[int, int](), Served()
    answered_ns = dict.fromkeys(range(count), -1)
    while due or waiting:
        if not waiting:
            core.now_ns = max(core.now_ns, due[0][0])
        while due and due[0][0] <= core.now_ns:
            instant_ns, robot = due.pop(0)
            waiting[robot] = instant_ns  # the newest of a robot replaces an older one
        batch = sorted(waiting, key=answered_ns.__getitem__)[:max_rows]
        core.run(lambda batch=batch: engine.invoke_many([requests[robot] for robot in batch]))  # type: ignore[misc]
        for robot in batch:
            served.append((robot, waiting.pop(robot), core.now_ns))
            answered_ns[robot] = core.now_ns
    return served


def _ages(thoughts: Served, chunks: Served) -> list[float]:
    """The age of what each invocation refers to [ms], after the first second."""
    ages_ms = []
    for robot in {robot for robot, _, _ in chunks}:
        ready = [
            Ready(query=query, source_ns=asked, ready_ns=done)
            for query, (_, asked, done) in enumerate(sorted(each for each in thoughts if each[0] == robot))
        ]
        for asked_ns in [asked for who, asked, _ in chunks if who == robot and asked >= QUERY_NS]:
            if (used := latest_ready(ready, asked_ns)) is not None:
                ages_ms.append((asked_ns - used.source_ns) / 1e6)
    return ages_ms


if __name__ == "__main__":
    sys.exit(main())
