"""Speed of collecting demonstrations on one core, and of our ``env.step`` compared with robosuite's.

Whole oracle episodes, with reset and planning, at three rates of rendering: none; 4 Hz, which covers PONDER's 1 Hz and
POUNCE's 4 Hz; and every step. In the same run and on the same core, robosuite's own step with two cameras of the same
size, if an interpreter with robosuite is given.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.report import Report, Row, show
from dual_system.tasks.task import task_names
from protocol.command_line import parse

_PEER_KEYS = ("simulated_s", "wall_s", "cpu_s")
_OUR_KEYS = ("stepped_s", "step_wall_s", "step_cpu_s")
LOOK_HZ = {0: "no pictures", 4: "two cameras at 1 Hz + 4 Hz", 20: "two cameras at 20 Hz"}


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedOptions:
    """Simulated seconds per wall second on one core."""

    tasks: tuple[str, ...] = ()
    """Names of the tasks. Empty: all."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, with one episode each: easy, medium, hard."""
    rounds: int = 1
    """Rounds; ways take turns."""
    image_px: int = 256
    peer_python: Path | None = None
    """Interpreter of an environment with robosuite 1.5.2; without it the peer's rows are missing."""
    peer_steps: int = 100


def measured(command: list[str]) -> list[dict[str, Any]]:
    """Runs a worker and returns its JSON lines."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[1:4])} failed: {done.stderr.strip().splitlines()[-1:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def row_of(name: str, episodes: list[dict[str, Any]]) -> Row:
    simulated_s, wall_s, cpu_s = (sum(e[what] for e in episodes) for what in ("simulated_s", "wall_s", "cpu_s"))
    return {
        "what": name,
        "episodes": len(episodes),
        "succeeded": sum(e["success"] for e in episodes),
        "simulated_s": round(simulated_s, 1),
        "simulated_s_per_wall_s": round(simulated_s / wall_s, 1),
        "simulated_s_per_cpu_s": round(simulated_s / cpu_s, 1),
        "slowest_episode": round(min(e["simulated_s"] / e["wall_s"] for e in episodes), 1),
        "episodes_per_hour": round(3600 * len(episodes) / wall_s),
    }


def step_row(name: str, runs: list[dict[str, Any]], keys: tuple[str, str, str], peer: Row | None) -> Row:
    """One row; ``keys`` name simulated, wall and processor seconds, ``peer`` is the row to compare with."""
    simulated_s, wall_s, cpu_s = (sum(run[key] for run in runs) for key in keys)
    steps = round(simulated_s * 20)
    row: Row = {
        "step": name,
        "steps": steps,
        "wall_ms_per_step": round(wall_s * 1e3 / steps, 2),
        "cpu_ms_per_step": round(cpu_s * 1e3 / steps, 2),
    }
    for what in ("wall", "cpu"):
        theirs = None if peer is None else float(peer[f"{what}_ms_per_step"] or 0)
        ours = float(row[f"{what}_ms_per_step"] or 0)
        row[f"robosuite_takes_times_{what}"] = None if theirs is None else round(theirs / ours, 1)
    return row


def main(argv: list[str] | None = None) -> int:
    options = parse(SpeedOptions, argv, prog="task-speed")
    tasks = options.tasks or task_names()
    report = Report(
        name="task_speed",
        question="How many simulated seconds does one core give in one wall second, and how many episodes in an hour?",
        config=options,
        warm_up="building the scene, and a first episode of each process (robosuite: building, reset and ten steps).",
    )
    ours: dict[tuple[str, int], list[dict[str, Any]]] = {(task, hz): [] for task in tasks for hz in LOOK_HZ}
    peers: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    if options.peer_python is not None:
        peer = [str(options.peer_python), str(Path(__file__).parent / "robosuite_speed.py")]
        measured([*peer, "cameras", str(options.image_px), "10"])  # numba compiles
    for _ in range(options.rounds):
        for task, hz in ours:
            worker = [sys.executable, "-m", "benchmarks.task_speed_worker", task, str(hz), str(options.image_px)]
            ours[task, hz] += measured([*worker, ",".join(map(str, options.seeds))])
            print(row_of(f"{task}, {LOOK_HZ[hz]}", ours[task, hz]), flush=True)
        for with_cameras in peers if options.peer_python is not None else ():
            arguments = ["cameras" if with_cameras else "blind", str(options.image_px), str(options.peer_steps)]
            peers[with_cameras] += measured([*peer, *arguments])
    by_rate = {hz: [e for (_, at_hz), found in ours.items() if at_hz == hz for e in found] for hz in LOOK_HZ}
    report.add_table("Oracle episodes on one core", [row_of(LOOK_HZ[hz], found) for hz, found in by_rate.items()])
    report.add_table("The same by task, no pictures", [row_of(task, ours[task, 0]) for task in tasks])
    rows: list[Row] = []
    for hz in (0, 20):
        peer_row = None
        if peers[hz > 0]:
            peer_row = step_row(f"robosuite Lift, {LOOK_HZ[hz]}", peers[hz > 0], _PEER_KEYS, None)
            rows.append(peer_row)
        rows.append(step_row(f"ours, {LOOK_HZ[hz]}", by_rate[hz], _OUR_KEYS, peer_row))
    report.add_table("env.step alone", rows)
    report.notes += [
        "Every process is pinned to one core; pictures are rendered in software, so a GPU would change these numbers.",
        "Physics differ: ours has 10 substeps of 5 ms a step and scripted joint targets, robosuite's Lift 25 of 2 ms, "
        "an operational-space controller and random actions. Both pictures are of the cameras' full size.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
