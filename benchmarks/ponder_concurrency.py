"""How old is a cognition when several robots think with one PONDER, and what does a greedy robot cost the others?

Robots ask once a period, all at the same instant, of one engine in one process: the worst case, which admission counts
with. Age is from the instant a query was due to its cognition on the host. "In common forwards" is how ponder-serve
runs; "one by one" allows a forward one row. The last rows have one robot that asks again the moment it is answered, and
one that writes a long text every time.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
import tyro

from benchmarks.report import Report, Row, show, spread
from ponder_server.contract import Frame, Opening
from ponder_server.engine import EngineConfig, QwenEngine
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_configs import tiny_cpu

MAX_CONTEXT_TOKENS = 16_384


@dataclass(frozen=True, slots=True, kw_only=True)
class ConcurrencyOptions:
    """Many robots on one engine."""

    robots: tuple[int, ...] = (1, 2, 4, 8)
    period_ms: int = 1000
    seconds: float = 6.0
    """Per row, after one second that is not counted."""
    text_tokens: int = 45
    """Of the robot that writes all the time."""


@dataclass(slots=True, kw_only=True)
class Robot:
    """A client: when it asks next, and how long its answers took."""

    name: str
    due_ns: int
    period_ns: int
    text_tokens: int | None = None
    is_thinking: bool = False

    def asks(self, now_ns: int) -> bool:
        return not self.is_thinking and now_ns >= self.due_ns


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(ConcurrencyOptions, args=argv, prog="ponder-concurrency")
    torch.set_num_threads(1)
    report = Report(
        name="ponder_concurrency",
        question="How old is a cognition when several robots think with one PONDER?",
        config=options,
        warm_up="the engine's own, and the first second of each row.",
    )
    ponder = Ponder.random(tiny_cpu(), seed=0)
    rows = []
    for count in options.robots:
        for name, max_rows in (("in common forwards", 8), ("one by one", 1)):
            ages_ms = _run(ponder, options, count, max_rows)
            rows.append(
                {"robots": count, "forwards": name} | spread([age for ages in ages_ms.values() for age in ages], "ms")
            )
    report.add_table(f"Age of a cognition, all robots asking at one instant, every {options.period_ms} ms", rows)
    others: list[Row] = []
    for name, change in (
        ("asks as all do", {}),
        ("asks again at once", {"period_ns": 0}),
        (f"writes {options.text_tokens} tokens each time", {"text_tokens": options.text_tokens}),
    ):
        ages_ms = _run(ponder, options, 4, 8, change)
        patient = [age_ms for robot, ages in ages_ms.items() if robot != "r0" for age_ms in ages]
        others.append({"the fourth robot": name, "its answers": len(ages_ms["r0"])} | spread(patient, "ms"))
    report.add_table("Age of a cognition of three robots, by what a fourth one does", others)
    report.notes += [
        "tiny_cpu with random weights, one thread; contexts grow by 133 tokens a query.",
        "A robot that is still thinking asks late, and the age of that answer includes the wait.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _run(
    ponder: Ponder,
    options: ConcurrencyOptions,
    count: int,
    max_rows: int,
    change: dict[str, int] | None = None,
) -> dict[str, list[float]]:
    """Ages in ms by robot; ``change`` is what makes the first robot another."""
    config = EngineConfig(
        max_context_tokens=MAX_CONTEXT_TOKENS, max_sessions=count, max_batch_rows=max_rows, when_full="pin-and-slide"
    )
    engine = QwenEngine(ponder, config)
    engine.warm_up()
    period_ns = options.period_ms * 1_000_000
    start_ns = time.perf_counter_ns()
    robots = {f"r{index}": Robot(name=f"r{index}", due_ns=start_ns, period_ns=period_ns) for index in range(count)}
    robots["r0"] = replace(robots["r0"], **(change or {}))
    frames = _frames(ponder)
    for name in robots:
        engine.open(name, Opening(instruction="pick up the red cube"))
    ages_ms: dict[str, list[float]] = {name: [] for name in robots}
    counted_from_ns, end_ns = start_ns + 1_000_000_000, start_ns + round((1 + options.seconds) * 1e9)
    while (now_ns := time.perf_counter_ns()) < end_ns:
        for robot in robots.values():
            if robot.asks(now_ns):
                engine.begin(robot.name, frames, force_text_tokens=robot.text_tokens)
                robot.is_thinking = True
        outcomes = engine.step()
        now_ns = time.perf_counter_ns()
        for outcome in outcomes:
            outcome.unwrap()
            robot = robots[outcome.session]
            if robot.due_ns >= counted_from_ns:
                ages_ms[robot.name].append((now_ns - robot.due_ns) / 1e6)
            robot.is_thinking = False
            robot.due_ns = robot.due_ns + robot.period_ns if robot.period_ns else now_ns
    return ages_ms


def _frames(ponder: Ponder) -> tuple[Frame, Frame]:
    first, second = np.random.default_rng(0).integers(0, 256, (2, *ponder.image_px, 3), dtype=np.uint8)
    return first, second


if __name__ == "__main__":
    sys.exit(main())
