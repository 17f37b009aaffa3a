"""Age of cognitions when several robots share one PONDER, and the effect of a greedy robot on the others.

Robots query one engine in one process once per period: all at the same instant, which is the worst case and admission's
assumption, or evenly spread. Age is the time from a query's due instant to its cognition on the host. "In common
forwards" is ponder-serve's way; "one by one" allows one row per forward. Further tables: as many robots as one core
should serve, for longer, with the worst of them; admission's limits and refusals; the effect of admission by short
contexts; and the effect on three robots of a fourth that queries again as soon as it is answered, or that generates a
long text every time.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from benchmarks.report import Report, Row, show, spread
from clock import schedules
from clock.timebase import NS_PER_MS
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from model_server.shell import percentile_ns
from ponder_server.admission import Admission
from ponder_server.contract import Frame, Opening, SessionError
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from protocol.command_line import parse

MAX_CONTEXT_TOKENS = 16_384
LONG_CONTEXT_TOKENS = 14_000
"""Leaves room for the queries of a row and for a text."""
BUDGET_MS = 1000
MAX_ROWS = 8
"""Largest number of rows in a forward, as in ponder-serve."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConcurrencyOptions:
    """Many robots on one engine."""

    robots: tuple[int, ...] = (1, 4, 8, 16)
    period_ms: int = 1000
    seconds: float = 6.0
    """Seconds per row, after an uncounted one."""
    many: int = 32
    many_seconds: float = 60.0
    """Seconds per row with ``many`` robots."""
    text_tokens: int = 45
    """Text length of the robot that always generates text."""
    threads: int = 1


@dataclass(slots=True, kw_only=True)
class Robot:
    """A client: the instant of its next query, and the ages of its cognitions."""

    name: str
    due_ns: int
    period_ns: int
    text_tokens: int | None = None
    is_thinking: bool = False
    num_due: int = 0
    ages_ms: list[float] = field(default_factory=list)


def main(argv: list[str] | None = None) -> int:
    options = parse(ConcurrencyOptions, argv, prog="ponder-concurrency")
    torch.set_num_threads(options.threads)
    report = Report(
        name="ponder_concurrency",
        question="How old is a cognition when several robots think with one PONDER?",
        config=options,
        warm_up="the engine's own, and the first second of each row.",
    )
    ponder = Ponder.random(tiny_cpu(), seed=0)
    title = f"Age of a cognition, every robot asking once in {options.period_ms} ms"
    report.add_table(title + ", all at one instant", _few(ponder, options))
    report.add_table(f"{title}: {options.many} robots for {options.many_seconds:.0f} s", _many(ponder, options))
    report.add_table("Admission, counting with the fires of this machine's warm-up", _admission(ponder, options))
    report.add_table(
        f"As many robots as {BUDGET_MS} ms admit, with contexts of {LONG_CONTEXT_TOKENS} tokens, all at one instant",
        _promised(ponder, options),
    )
    report.add_table("Age of a cognition of three robots, by what a fourth one does", _beside_a_fourth(ponder, options))
    report.notes += [
        f"tiny_cpu with random weights, {options.threads} thread(s); contexts grow by 133 tokens a query.",
        "A robot that is still thinking asks late, and the age of that answer includes the wait.",
        "The worst robot is the one with the largest p95.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _few(ponder: Ponder, options: ConcurrencyOptions) -> list[Row]:
    rows: list[Row] = []
    for count in options.robots:
        for name, max_rows in (("in common forwards", MAX_ROWS), ("one by one", 1)):
            robots = _run(ponder, options, count, options.seconds, max_rows=max_rows)
            rows.append({"robots": count, "forwards": name} | spread(_ages(robots), "ms"))
    return rows


def _many(ponder: Ponder, options: ConcurrencyOptions) -> list[Row]:
    rows: list[Row] = []
    for name, is_spread in (("at one instant", False), ("evenly spread", True)):
        robots = _run(ponder, options, options.many, options.many_seconds, is_spread=is_spread)
        worst = max(robots, key=lambda robot: float(np.percentile(robot.ages_ms, 95, method="inverted_cdf")))
        answers = {"answered": len(_ages(robots)), "due": sum(robot.num_due for robot in robots)}
        fewest = {"fewest of one robot": min(len(robot.ages_ms) for robot in robots)}
        for whose, ages_ms in (("all", _ages(robots)), (f"the worst, {worst.name}", worst.ages_ms)):
            rows.append({"they ask": name, "whose": whose} | answers | fewest | spread(ages_ms, "ms"))
    return rows


def _admission(ponder: Ponder, options: ConcurrencyOptions) -> list[Row]:
    durations_ns = _engine(ponder, 1).warm_up_full()
    p50_ns, p99_ns = (percentile_ns(durations_ns, percent) for percent in (50, 99))
    tight_ms = -(-((options.many - 1) * p50_ns + p99_ns) // 1_000_000)
    rows: list[Row] = []
    for budget_ms in (tight_ms, BUDGET_MS):
        admitted, refusal = _admitted(durations_ns, budget_ms, options)
        rows.append(
            {"max_age_ms": options.period_ms + budget_ms, "admitted": admitted, "the next one is told": refusal}
        )
    return rows


def _admitted(durations_ns: list[int], budget_ms: int, options: ConcurrencyOptions) -> tuple[int, str]:
    """The number of admitted robots, and the refusal of the next one."""
    p50_ns, p99_ns = (percentile_ns(durations_ns, percent) for percent in (50, 99))
    admission = Admission(fire_p50_ns=p50_ns, fire_p99_ns=p99_ns)
    period_ns, budget_ns = options.period_ms * NS_PER_MS, budget_ms * NS_PER_MS
    schedule = replace(schedules.realtime(), query_period_ns=period_ns, max_age_ns=period_ns + budget_ns)
    while True:
        try:
            admission.admit(f"r{len(admission.admitted)}", schedule)
        except SessionError as error:
            return len(admission.admitted), str(error)


def _promised(ponder: Ponder, options: ConcurrencyOptions) -> list[Row]:
    engine = _engine(ponder, 1)
    rows: list[Row] = []
    for counted_with, durations_ns in (("full", engine.warm_up_full()), ("short", engine.warm_up())):
        count = max(1, _admitted(durations_ns, BUDGET_MS, options)[0])
        robots = _run(ponder, options, count, options.seconds, context_tokens=LONG_CONTEXT_TOKENS)
        p50_ms = round(percentile_ns(durations_ns, 50) / 1e6, 1)
        rows.append(
            {"counted with contexts": counted_with, "fire_p50_ms": p50_ms, "admitted": count}
            | spread(_ages(robots), "ms")
        )
    return rows


def _beside_a_fourth(ponder: Ponder, options: ConcurrencyOptions) -> list[Row]:
    rows: list[Row] = []
    for name, change in (
        ("asks as all do", {}),
        ("asks again at once", {"period_ns": 0}),
        (f"writes {options.text_tokens} tokens each time", {"text_tokens": options.text_tokens}),
    ):
        fourth, *patient = _run(ponder, options, 4, options.seconds, change=change)
        rows.append({"the fourth robot": name, "its answers": len(fourth.ages_ms)} | spread(_ages(patient), "ms"))
    return rows


def _ages(robots: list[Robot]) -> list[float]:
    return [age_ms for robot in robots for age_ms in robot.ages_ms]


def _run(
    ponder: Ponder,
    options: ConcurrencyOptions,
    count: int,
    seconds: float,
    *,
    max_rows: int = MAX_ROWS,
    is_spread: bool = False,
    context_tokens: int = 0,
    change: dict[str, int] | None = None,
) -> list[Robot]:
    """Runs ``count`` robots and returns them with their ages; ``change`` modifies the first one.

    Each context begins with about ``context_tokens`` of the same demonstration, which is encoded once.
    """
    engine = _engine(ponder, count, max_rows=max_rows)
    engine.warm_up()
    frames = _frames(ponder)
    period_ns = options.period_ms * 1_000_000
    num_shown = context_tokens // (ponder.format.num_image_tokens + 2)
    opening = Opening(instruction="pick up the red cube", demo_frames=((frames[0],),) * num_shown)
    for index in range(count):
        engine.open(f"r{index}", opening)
    start_ns = time.perf_counter_ns()
    robots = {}
    for index in range(count):
        due_ns = start_ns + is_spread * index * period_ns // count
        robots[f"r{index}"] = Robot(name=f"r{index}", due_ns=due_ns, period_ns=period_ns)
    robots["r0"] = replace(robots["r0"], **(change or {}))
    counted_from_ns, end_ns = start_ns + 1_000_000_000, start_ns + round((1 + seconds) * 1e9)
    while True:
        now_ns = time.perf_counter_ns()
        for robot in robots.values():
            if not robot.is_thinking and robot.due_ns <= min(now_ns, end_ns - 1):
                engine.begin(robot.name, frames, force_text_tokens=robot.text_tokens)
                robot.is_thinking = True
        if not any(robot.is_thinking for robot in robots.values()):
            if now_ns >= end_ns:
                break
            time.sleep(1e-3)
        outcomes = engine.step()
        now_ns = time.perf_counter_ns()
        for outcome in outcomes:
            outcome.unwrap()
            robot = robots[outcome.session]
            if robot.due_ns >= counted_from_ns:
                robot.ages_ms.append((now_ns - robot.due_ns) / 1e6)
            robot.is_thinking = False
            robot.due_ns = robot.due_ns + robot.period_ns if robot.period_ns else now_ns
    for robot in robots.values():
        robot.num_due = round(seconds * 1e9 / robot.period_ns) if robot.period_ns else len(robot.ages_ms)
    return list(robots.values())


def _engine(ponder: Ponder, max_sessions: int, *, max_rows: int = MAX_ROWS) -> QwenEngine:
    return QwenEngine(
        ponder,
        EngineConfig(
            max_context_tokens=MAX_CONTEXT_TOKENS,
            max_sessions=max_sessions,
            max_batch_rows=max_rows,
            when_full="pin-and-slide",
        ),
    )


def _frames(ponder: Ponder) -> tuple[Frame, Frame]:
    first, second = np.random.default_rng(0).integers(0, 256, (2, *ponder.image_px, 3), dtype=np.uint8)
    return first, second


if __name__ == "__main__":
    sys.exit(main())
