"""Scores of RoboMME's episodes from the gateway's logs, as results files for pp-tables.

python examples/robomme/scores.py METADATA LOGS OUT

METADATA: the benchmark's list of one task's episodes, record_dataset_TASK_metadata.json of the split that was played.
LOGS: the folder of a gateway that was given the episodes in their order from 0 on, seeds from 0 on, and nothing else.
OUT: the folder for results.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from protocol.mcap_log import read_log


def main(metadata: Path, logs: Path, out: Path) -> None:
    listed = {each["episode"]: each for each in json.loads(metadata.read_text())["records"]}
    task = next(iter(listed.values()))["task"]
    found = sorted(
        (_episode(path, listed) for path in logs.rglob(f"*/{task}/*.mcap")), key=lambda each: each["episode"]
    )
    config = {"benchmark": "RoboMME", "metadata": metadata.name}
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_text(json.dumps({"config": config, "episodes": found}, indent=1) + "\n")
    print(f"{sum(each['success'] for each in found)} of {len(found)} solved")


def _episode(path: Path, listed: dict[int, Any]) -> dict[str, Any]:
    log = read_log(path)
    assert log.result is not None, f"{path} does not say how its episode ended"
    scene = listed[log.info.seed]
    assert scene["task"] == log.info.task, f"{path} is an episode of {log.info.task}, expected {scene['task']}"
    return {
        "task": log.info.task,
        "episode": log.info.seed,
        "seed": scene["seed"],
        "difficulty": scene["difficulty"],
        "success": log.result.is_success,
        "status": log.result.status.name,
        "steps": log.result.num_ticks,
        "null_invocations": sum(each.ref_query is None for each in log.invocations),
        "invocations": len(log.invocations),
    }


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*(Path(argument) for argument in sys.argv[1:]))
