"""Plays scenes of RoboCasa-DC and writes how each ended.

    python -m ponderpounce_robocasa --scenes DATA/eval_envs --demonstrations DATA/eval_set_gr1 \\
        --cameras DATA/video_key_map_gr1.json --tasks CloseDrawer --out results.jsonl
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ponderpounce_robocasa import layout
from ponderpounce_robocasa.demonstrations import DemonstrationError, Demonstrations, frames_of, shown
from ponderpounce_robocasa.play import play
from ponderpounce_robocasa.scenes import SceneError, read_scene, seeds_of
from ponderpounce_robocasa.wire import Policy, Refused


def main(argv: list[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m ponderpounce_robocasa", description=__doc__.partition("\n")[0])
    parser.add_argument("--url", default="ws://127.0.0.1:8000", help="address of pp-gateway --dialect openpi")
    parser.add_argument("--api-key-file", type=Path, help="file with the word that the gateway wants")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of TASK/SEED with the restored starts")
    parser.add_argument("--demonstrations", type=Path, help="folder of the GR-1's data set; left out: none is shown")
    parser.add_argument("--cameras", type=Path, help="video_key_map_gr1.json, with --demonstrations")
    parser.add_argument("--tasks", nargs="+", default=list(layout.CATEGORY_BALANCED), help="names of tasks")
    parser.add_argument("--episodes", type=int, default=50, help="largest number of scenes of a task")
    parser.add_argument("--demo-fps", type=int, default=1, help="frames a second that are shown of a demonstration")
    parser.add_argument("--max-demo-frames", type=int, default=64, help="most frames of a demonstration; 0: all")
    parser.add_argument("--max-steps", type=int, default=layout.MAX_STEPS, help="longest episode in steps of 50 ms")
    parser.add_argument(
        "--environment", default="ponderpounce_robocasa.real:make",
        help="MODULE:FUNCTION that builds RoboCasa's environment from task and seed",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="file for one line of JSON an episode")
    said = parser.parse_args(argv)
    if (said.demonstrations is None) != (said.cameras is None):
        parser.error("--demonstrations and --cameras belong together")
    try:
        for task in said.tasks:
            layout.check_task(task)
        key = said.api_key_file.read_text(encoding="utf-8").strip() if said.api_key_file else ""
        with Policy(said.url, key) as policy, said.out.open("a", encoding="utf-8") as out:
            layout.check_server(policy.metadata)
            _play_all(said, policy, out)
    except (Refused, layout.Unfit, SceneError, DemonstrationError, OSError, ImportError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _play_all(said: argparse.Namespace, policy: Policy, out: Any) -> None:
    make = _function(said.environment)
    demonstrations = Demonstrations(said.demonstrations, said.cameras) if said.demonstrations else None
    for task in said.tasks:
        seeds = seeds_of(said.scenes, task)[: said.episodes]
        env = make(task, seeds[0])
        for seed in seeds:
            scene, number, demo = read_scene(said.scenes, task, seed), None, []
            if demonstrations is not None:
                number, path = demonstrations.video_of(task, seed)
                frames = frames_of(path)
                demo = [frames[at] for at in shown(len(frames), said.demo_fps, said.max_demo_frames)]
            outcome = play(env, policy, scene, demo, said.demo_fps, said.max_steps)
            told = {"task": task, "seed": seed, "demonstration": number, "demo_frames": len(demo),
                    "success": outcome.is_success, "steps": outcome.num_steps, "held": outcome.num_held}  # fmt: skip
            out.write(json.dumps(told) + "\n")
            out.flush()


def _function(name: str) -> Callable[[str, int], Any]:
    module, _, function = name.partition(":")
    found: Callable[[str, int], Any] = getattr(importlib.import_module(module), function)
    return found


if __name__ == "__main__":
    sys.exit(main())
