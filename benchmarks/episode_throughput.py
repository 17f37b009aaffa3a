"""Simulated seconds per wall second in lockstep: in one process, over zenoh, and without servers.

Lockstep waits for every answer, so this shows the cost of a suite of episodes, and the bus's share of it. The oracle
rows are the ceiling: the same robot, rendering and log, without models and without a bus.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from benchmarks.report import Report, Row, show, spread
from protocol.command_line import parse

CONTROL_HZ = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ThroughputOptions:
    """Simulated seconds per wall second."""

    episodes: int = 6
    """Episodes per row and round, after an uncounted one."""
    rounds: int = 2
    """Rounds; rows take turns."""
    max_steps: int = 200
    task: str = "PickHighlight"


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    name: str
    arguments: tuple[str, ...]


WAYS = (
    Way(name="oracle, no servers", arguments=("--policy", "oracle")),
    Way(name="oracle, no servers, no log, hence no pictures", arguments=("--policy", "oracle", "--no-record")),
    Way(name="lockstep in one process", arguments=("--in-process",)),
    Way(name="lockstep in one process, no log", arguments=("--in-process", "--no-record")),
    Way(name="lockstep over zenoh, three processes", arguments=("--local",)),
    Way(name="lockstep over zenoh, three processes, no log", arguments=("--local", "--no-record")),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    simulated_s: float
    wall_s: float


def run(way: Way, options: ThroughputOptions) -> list[Episode]:
    """Counted episodes of one run of ``sim-client``, each from its reset to its line in results.json."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sim_client", "--task", options.task, "--out", folder, "--no-progress"]
        command += ["--episodes", str(options.episodes + 1), "--max-steps", str(options.max_steps), *way.arguments]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        client = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        results = Path(folder) / "results.json"
        written_ns: list[int] = []
        while client.poll() is None:  # results.json is replaced after every episode: its times are the episodes' ends
            if results.exists() and (at_ns := results.stat().st_mtime_ns) not in written_ns[-1:]:
                written_ns.append(at_ns)
            time.sleep(0.01)
        if client.returncode != 0 or len(written_ns) != options.episodes + 1:
            raise RuntimeError(f"{way.name}: exit code {client.returncode} after {len(written_ns)} episodes")
        steps = [episode["steps"] for episode in json.loads(results.read_text())["episodes"]]
    ends = zip(pairwise(written_ns), steps[1:], strict=True)
    return [Episode(simulated_s=count / CONTROL_HZ, wall_s=(end - start) / 1e9) for (start, end), count in ends]


def row_of(name: str, episodes: list[Episode]) -> Row:
    simulated_s, wall_s = (sum(getattr(e, what) for e in episodes) for what in ("simulated_s", "wall_s"))
    per_episode = spread([e.simulated_s / e.wall_s for e in episodes], "rate")
    return {
        "way": name,
        "episodes": len(episodes),
        "ticks": round(simulated_s * CONTROL_HZ),
        "simulated_s_per_s": round(simulated_s / wall_s, 2),
        "worst_episode": per_episode["min_rate"],
        "best_episode": per_episode["max_rate"],
        "wall_ms_per_tick": round(wall_s * 1e3 / (simulated_s * CONTROL_HZ), 2),
    }


def main(argv: list[str] | None = None) -> int:
    options = parse(ThroughputOptions, argv, prog="episode-throughput")
    report = Report(
        name="episode_throughput",
        question="How many simulated seconds does one wall second give in lockstep?",
        config=options,
        warm_up="starting the processes, and the first episode of each run.",
    )
    episodes: dict[str, list[Episode]] = {way.name: [] for way in WAYS}
    for index in range(options.rounds):
        turn = index % len(WAYS)
        for way in WAYS[turn:] + WAYS[:turn]:
            episodes[way.name] += run(way, options)
            print(row_of(way.name, episodes[way.name]), flush=True)
    report.add_table("Simulated seconds per wall second", [row_of(way.name, episodes[way.name]) for way in WAYS])
    report.notes += [
        "Reset of the scene, opening and closing of the episode and of its log are inside. n is small (whole "
        "episodes), so the worst and the best are given instead of percentiles.",
        "The paper's schedule: both models at 1 Hz. Tiny models with random weights on one CPU core each.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
