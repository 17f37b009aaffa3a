"""What does counsel cost? Queries of one PONDER that reads an episode alone and of the same one in several views.

Both read the same noise, in turns, each beginning every other one: the same number of queries in contexts that grow
alike. A query is timed from frames to cognition, whether it speaks or not.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks.report import Report, Row, show, spread
from dual_system.models.ponder.checkpoint import load_ponder
from ponder_server.__main__ import build_engine
from ponder_server.config import PonderOptions
from ponder_server.contract import BatchingEngine, Opening
from ponder_server.council import Council
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

_SESSION = "measured"


@dataclass(frozen=True, slots=True, kw_only=True)
class CounselOptions:
    """A checkpoint that asks for counsel; alone is the same one without."""

    checkpoint: Path
    queries: int = 60
    """Of each, after ten that are not counted."""
    demo_s: int = 12
    """Seconds of demonstration, a picture each."""


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(CounselOptions, args=argv, prog="counsel-latency")
    report = Report(
        name="counsel_latency",
        question="What does counsel cost?",
        config=options,
        warm_up="ten queries of each.",
    )
    ponder = load_ponder(options.checkpoint)
    if ponder.format.counsel is None:
        raise ValueError(f"{options.checkpoint} asks for no counsel; give one whose ponder.json does")
    ponder.format = replace(ponder.format, counsel=None)
    council = build_engine(PonderOptions(checkpoint=options.checkpoint))
    assert isinstance(council, Council)
    engines: list[tuple[str, BatchingEngine]] = [
        ("alone", QwenEngine(ponder, EngineConfig(max_sessions=1))),
        (f"counsel of {council.num_members} views", council),
    ]
    rng = np.random.default_rng(0)
    size = (256, 256, 3)
    demo = tuple(tuple(rng.integers(0, 256, size, np.uint8) for _ in range(2)) for _ in range(options.demo_s))
    openings: list[Row] = []
    for name, engine in engines:
        start_ns = time.perf_counter_ns()
        num_tokens = engine.open(_SESSION, Opening(instruction="pick up the red cube", demo_frames=demo))
        took_ms = (time.perf_counter_ns() - start_ns) / 1e6
        openings.append({"reading": name, "tokens": num_tokens, "opening_ms": round(took_ms, 1)})
    report.add_table("One opening each, with a demonstration", openings)
    took_by: dict[str, list[float]] = {name: [] for name, _ in engines}
    for count in range(10 + options.queries):
        frames = (rng.integers(0, 256, size, np.uint8), rng.integers(0, 256, size, np.uint8))
        state = rng.normal(0.0, 0.1, 8).astype(np.float32)
        for name, engine in engines if count % 2 else reversed(engines):
            start_ns = time.perf_counter_ns()
            engine.fire(_SESSION, frames, proprio=state)
            took_by[name].append((time.perf_counter_ns() - start_ns) / 1e6)
    rows: list[Row] = []
    for name, took in took_by.items():
        rows.append({"reading": name} | spread(took[10:], "ms"))
    report.add_table("Queries, frames to cognition", rows)
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
