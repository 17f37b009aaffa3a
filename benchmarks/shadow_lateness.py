"""Does a shadow touch the loop? Lateness of ticks in real time, in blocks without and with shadows, in turn.

One pair of servers and one clock for all blocks. In a block with shadows a second PONDER and a second POUNCE are
started before it, asked what the others are asked, recorded, and stopped after it. The interval of the difference is a
bootstrap over whole seconds: ticks of one second are late together.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Report, Row, show, spread
from benchmarks.rig import ROBOT, Rig
from clock.report import num_starved
from protocol import messages as m
from protocol.command_line import parse
from protocol.mcap_log import read_log
from protocol.sockets import endpoint
from sim_client.launch import Daemons

WAYS = ("without", "with shadows")
SHADOWS = ("ponder", "pounce")
READY_S = 300.0
TICKS_PER_S = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class LatenessOptions:
    """Blocks of ticks at 20 Hz."""

    blocks: int = 4
    """Number of blocks, every second one with shadows."""
    block_s: float = 300.0
    """Length of a block in seconds; if an episode ends early, more are played."""
    warm_up_ticks: int = 60
    """Uncounted ticks at the start of each episode: shadows come in then."""
    resamples: int = 2000
    task: str = "PickHighlight"


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    late_ms: np.ndarray
    starved: int
    skipped: int
    shadow_answers: int


def main(argv: list[str] | None = None) -> int:
    options = parse(LatenessOptions, argv, prog="shadow-lateness")
    report = Report(
        name="shadow_lateness",
        question="Are ticks later while a second PONDER and a second POUNCE are fed live?",
        config=options,
        warm_up=f"the first {options.warm_up_ticks} ticks of each episode.",
    )
    blocks: dict[str, list[Block]] = {way: [] for way in WAYS}
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        for index in range(options.blocks):
            way = WAYS[index % 2]
            block = _block(rig, way, options, Path(folder) / str(index))
            blocks[way].append(block)
            rows.append(_row(str(index), way, [block]))
            print(rows[-1], flush=True)
    rows += [_row("all", way, blocks[way]) for way in WAYS]
    report.add_table("Lateness of ticks", rows)
    report.add_table("p99 with shadows minus p99 without", [_difference(blocks, options.resamples)])
    report.notes += [
        "late_ms: from a tick's deadline to the instant at which its row was decided, by the clock service.",
        "Tiny models with random weights (CPU), two 256 px cameras rendered on the CPU, recorder on, all processes on "
        "this machine: shadows take cores from everybody.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _block(rig: Rig, way: str, options: LatenessOptions, out: Path) -> Block:
    wanted = round(options.block_s * TICKS_PER_S)
    ticks: list[m.Tick] = []
    num_answers = episode = 0
    with _shadows(rig.daemons, rig.endpoint("clock"), out.name) if way == WAYS[1] else _nobody() as endpoints:
        while len(ticks) < wanted:
            left = wanted - len(ticks) + options.warm_up_ticks
            arguments = [*endpoints, "--task", options.task, "--seed", str(episode), "--max-steps", str(left)]
            folder = out / str(episode)
            player = rig.play(arguments, folder)
            rig.listen(lambda player=player: player.poll() is not None, left / TICKS_PER_S + READY_S)  # type: ignore[misc]
            if len(rig.ticks()) <= options.warm_up_ticks:
                why = [each["reason"] for path in folder.glob("results.json") for each in _episodes(path)]
                raise RuntimeError(f"block {out.name}: the episode never ran: {', '.join(why) or 'see sim.log'}")
            ticks += rig.ticks()[options.warm_up_ticks :]
            records = [read_log(path) for path in folder.rglob("*.mcap")]
            num_answers += sum(len(each.shadow_cognitions) + len(each.shadow_chunks) for each in records)
            episode += 1
    if (num_answers > 0) != (way == WAYS[1]):
        raise RuntimeError(f"block {out.name} {way}: {num_answers} answers of shadows in its logs")
    counted = ticks[:wanted]
    late_ms = np.array([tick.late_ns / 1e6 for tick in counted if tick.level != m.Level.SKIPPED])
    skipped = len(counted) - len(late_ms)
    return Block(late_ms=late_ms, starved=num_starved(counted), skipped=skipped, shadow_answers=num_answers)


def _episodes(results: Path) -> list[dict[str, str]]:
    return json.loads(results.read_text())["episodes"]  # type: ignore[no-any-return]


@contextmanager
def _nobody() -> Iterator[list[str]]:
    yield []


@contextmanager
def _shadows(daemons: Daemons, at_clock: str, block: str) -> Iterator[list[str]]:
    """A warm shadow of each server; yields their endpoints."""
    endpoints, names = [], [f"{proc}-shadow-{block}" for proc in SHADOWS]
    for proc, name in zip(SHADOWS, names, strict=True):
        endpoints.append(endpoint(name, daemons.sockets()))
        arguments = ["--shadow", "--link.robot", ROBOT, "--link.listen", endpoints[-1], "--link.connect", at_clock]
        daemons.start(name, f"{proc}_server", arguments)
    try:
        daemons.await_line(names, " ready infer", READY_S)
        yield endpoints
    finally:
        for name in names:
            daemons.stop(name)


def _row(block: str, way: str, blocks: list[Block]) -> Row:
    late_ms = np.concatenate([each.late_ms for each in blocks])
    return {
        "block": block,
        "shadows": way,
        **spread([float(each) for each in late_ms], "late_ms"),
        "starved": sum(each.starved for each in blocks),
        "skipped": sum(each.skipped for each in blocks),
        "shadow_answers": sum(each.shadow_answers for each in blocks),
    }


def _difference(blocks: dict[str, list[Block]], resamples: int) -> Row:
    """Difference of p99 and its 95% interval."""
    rng = np.random.default_rng(0)
    seconds = {way: [each for block in blocks[way] for each in _seconds(block.late_ms)] for way in WAYS}
    found = {way: _p99(seconds[way]) for way in WAYS}
    drawn = {
        way: [
            _p99([seconds[way][index] for index in rng.integers(len(seconds[way]), size=len(seconds[way]))])
            for _ in range(resamples)
        ]
        for way in WAYS
    }
    differences = np.array(drawn[WAYS[1]]) - np.array(drawn[WAYS[0]])
    low, high = np.percentile(differences, (2.5, 97.5))
    return {
        "difference_ms": round(found[WAYS[1]] - found[WAYS[0]], 3),
        "low_ms": round(float(low), 3),
        "high_ms": round(float(high), 3),
        "seconds_with": len(seconds[WAYS[1]]),
        "seconds_without": len(seconds[WAYS[0]]),
    }


def _seconds(late_ms: np.ndarray) -> list[np.ndarray]:
    return np.array_split(late_ms, max(1, len(late_ms) // TICKS_PER_S))


def _p99(seconds: list[np.ndarray]) -> float:
    return float(np.percentile(np.concatenate(seconds), 99, method="inverted_cdf"))


if __name__ == "__main__":
    sys.exit(main())
