"""Lateness of a real-time episode's ticks, and missed ticks: a histogram of ``late_ns``, 60 s per row.

Rows: the daemons with default options (three processes, recorder on), the clock service embedded in sim-client, the
recorder off, and the naive loop ``while True: step(); time.sleep(0.05)`` around the same simulated robot.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from benchmarks.report import Report, Row, show, spread
from benchmarks.rig import Rig
from clock.report import num_starved
from dual_system.tasks.environment import make_environment
from protocol import messages as m
from protocol.command_line import parse

PERIOD_NS = 50_000_000
BINS_MS = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, np.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class JitterOptions:
    """Lateness of ticks at 20 Hz."""

    seconds: int = 60
    """Seconds of ticks per row; if an episode ends early, more are played."""
    warm_up_ticks: int = 40
    """Uncounted ticks at the start of each episode."""
    task: str = "PickHighlight"


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    name: str
    with_clock: bool
    arguments: tuple[str, ...]


WAYS = (
    Way(name="three daemons, recorder on", with_clock=True, arguments=()),
    Way(name="clock embedded in sim-client, recorder on", with_clock=False, arguments=("--clock", "embedded")),
    Way(name="three daemons, recorder off", with_clock=True, arguments=("--no-record",)),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """The counted ticks of one way: each one's lateness, and its interval from the previous one."""

    late_ms: list[float]
    interval_ms: list[float]
    missed: int
    episodes: int


def play(way: Way, options: JitterOptions) -> Played:
    """Runs episodes until enough ticks are recorded."""
    wanted = options.seconds * 20 + options.warm_up_ticks
    episodes: list[list[m.Tick]] = []
    while sum(map(len, episodes)) < options.seconds * 20:
        with tempfile.TemporaryDirectory() as folder, Rig(Path(folder), with_clock=way.with_clock) as rig:
            arguments = ["--task", options.task, "--seed", str(len(episodes)), "--max-steps", str(max(wanted, 1300))]
            player = rig.play([*arguments, *way.arguments], Path(folder))
            ticks = _hear(rig, player, wanted, options.seconds + 120.0)
        if len(ticks) <= options.warm_up_ticks:
            raise RuntimeError(f"{way.name}: the episode never ran")
        episodes.append(ticks)
    return _judge([ticks[options.warm_up_ticks :] for ticks in episodes], options.seconds * 20)


def _hear(rig: Rig, player: subprocess.Popen[bytes], wanted: int, patience_s: float) -> list[m.Tick]:
    rig.listen(lambda: player.poll() is not None or len(rig.ticks()) >= wanted, patience_s)
    return rig.ticks()


def _judge(episodes: Sequence[Sequence[m.Tick]], limit: int) -> Played:
    counted = [tick for ticks in episodes for tick in ticks][:limit]
    commanded = [tick for tick in counted if tick.level != m.Level.SKIPPED]
    skipped = len(counted) - len(commanded)
    return Played(
        late_ms=[tick.late_ns / 1e6 for tick in commanded],
        interval_ms=[(b.decided_ns - a.decided_ns) / 1e6 for t in episodes for a, b in pairwise(t)][: limit - 1],
        missed=skipped + sum(num_starved(ticks) for ticks in episodes),
        episodes=len(episodes),
    )


def sleep_loop(options: JitterOptions) -> Played:
    """The naive loop: the same robot, stepped and rendered, then 50 ms of sleep."""
    num_ticks = options.seconds * 20
    instants_ns = []
    with make_environment(options.task, max_steps=num_ticks + options.warm_up_ticks) as environment:
        command = np.append(environment.reset(0).state[:7], 1.0).astype(np.float32)
        for _ in range(num_ticks + options.warm_up_ticks):
            instants_ns.append(time.monotonic_ns())
            environment.step(command)
            time.sleep(PERIOD_NS / 1e9)
    counted = instants_ns[options.warm_up_ticks :]
    late_ms = [(at_ns - counted[0] - k * PERIOD_NS) / 1e6 for k, at_ns in enumerate(counted)]
    intervals_ms = [(b - a) / 1e6 for a, b in pairwise(counted)]
    missed = int(late_ms[-1] // 50)  # the schedule had this many ticks more in the same time
    return Played(late_ms=late_ms, interval_ms=intervals_ms, missed=missed, episodes=1)


def row_of(name: str, played: Played) -> Row:
    interval = spread([abs(value - 50.0) for value in played.interval_ms], "ms")
    return {
        "way": name,
        "episodes": played.episodes,
        **spread(played.late_ms, "late_ms"),
        "missed_ticks": played.missed,
        "interval_off_p50_ms": interval["p50_ms"],
        "interval_off_p99_ms": interval["p99_ms"],
    }


def histogram(played: dict[str, Played]) -> list[Row]:
    counts = {name: np.histogram(p.late_ms, BINS_MS)[0] for name, p in played.items()}
    bounds = pairwise(BINS_MS)
    return [
        {"late_ms": f"{low:g} to {high:g}" if high < np.inf else f"{low:g} and more"}
        | {name: int(count[index]) for name, count in counts.items()}
        for index, (low, high) in enumerate(bounds)
    ]


def main(argv: list[str] | None = None) -> int:
    options = parse(JitterOptions, argv, prog="playback-jitter")
    report = Report(
        name="playback_jitter",
        question="How late are the ticks of a real-time episode at 20 Hz, and are any missed?",
        config=options,
        warm_up=f"the first {options.warm_up_ticks} ticks of each episode.",
    )
    played = {}
    for way in WAYS:
        played[way.name] = play(way, options)
        print(row_of(way.name, played[way.name]), flush=True)
    played["time.sleep(0.05) after each step"] = sleep_loop(options)
    report.add_table("Lateness", [row_of(name, p) for name, p in played.items()])
    report.add_table("Histogram: ticks by lateness", histogram(played))
    report.notes += [
        "late_ms: from a tick's deadline to the instant at which its row was decided, by the clock service, which "
        "publishes it at once. missed: skipped by a stalled clock service, or without a usable row; of the sleep loop, "
        "ticks of a 20 Hz schedule that it did not reach in its time. "
        "interval_off: how far the time between two ticks was from 50 ms.",
        "Tiny models with random weights (CPU), two 256 px cameras rendered on the CPU, all processes on this machine. "
        "The sleep loop has no models and no bus, only the robot: each of its periods is 50 ms plus the work.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
