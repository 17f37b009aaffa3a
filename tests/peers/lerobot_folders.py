"""Run by LeRobot's Python, not by ours: writes folders with LeRobot's own tools, and says what it reads of one of ours.

python lerobot_folders.py write ROOT     ten frames a second, two cameras; also merged, cut, and without videos
python lerobot_folders.py read FOLDER    JSON on stdout
python lerobot_folders.py rows FOLDER    the same, of any robot's: every row
python lerobot_folders.py pairs FOLDER   the same, of pairs: the episodes that a split has seen
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS, PX = 10, 96
LENGTHS = (31, 24, 27)


def features(camera: str) -> dict:
    numbers = {"dtype": "float32", "shape": (8,), "names": [f"n{place}" for place in range(8)]}
    text = {"dtype": "string", "shape": (1,), "names": None}
    picture = {"dtype": camera, "shape": (PX, PX, 3), "names": ["height", "width", "channels"]}
    return {
        "observation.state": numbers,
        "action": numbers,
        "subgoal": text,
        "observation.images.top": picture,
        "observation.images.hand": picture,
    }


def write(root: Path, camera: str, seed: int) -> LeRobotDataset:
    data = LeRobotDataset.create(
        f"test/{root.name}", FPS, features(camera), root=root, robot_type="panda", use_videos=camera == "video"
    )
    for episode, length in enumerate(LENGTHS):
        rng = np.random.default_rng([seed, episode])
        states = rng.uniform(-0.2, 0.2, (length, 8)).astype(np.float32)
        for row in range(length):
            picture = np.full((PX, PX, 3), 20 + 5 * row, np.uint8)
            frame = {
                "observation.state": states[row],
                "action": states[min(row + 1, length - 1)],
                "subgoal": "reach it" if row < length // 2 else "lift it",
                "observation.images.top": picture,
                "observation.images.hand": 255 - picture,
                "task": f"pick number {episode}",
            }
            data.add_frame(frame)
        data.save_episode()
    data.finalize()
    return LeRobotDataset(f"test/{root.name}", root=root, video_backend="pyav")


def read(root: Path) -> dict:
    data = LeRobotDataset("test/ours", root=root, video_backend="pyav")
    item = data[len(data) - 1]
    return {
        "episodes": data.num_episodes,
        "frames": data.num_frames,
        "language": data.meta.has_language_columns,
        "task": item["task"],
        "persistent": [
            {name: row[name] for name in ("role", "content", "style", "timestamp")}
            for row in data.hf_dataset[0]["language_persistent"]
        ],
        "events": data.hf_dataset[0]["language_events"],
        "picture": list(item["observation.images.front"].shape),
    }


def rows(root: Path) -> dict:
    data = LeRobotDataset("test/rows", root=root, video_backend="pyav")
    items = [data[row] for row in range(len(data))]
    return {
        "fps": data.fps,
        "robot": data.meta.robot_type,
        "names": [data.features[name]["names"] for name in ("observation.state", "action")],
        "state": [item["observation.state"].tolist() for item in items],
        "action": [item["action"].tolist() for item in items],
        "level": [item["level"] for item in items],
        "task": [item["task"] for item in items],
        "persistent": [row["language_persistent"] for row in data.hf_dataset],
        "events": [row["language_events"] for row in data.hf_dataset],
        "pictures": {
            key: [(255 * item[key].permute(1, 2, 0)).round().int().tolist() for item in items[:3]]
            for key in data.meta.camera_keys
        },
    }


def pairs(root: Path) -> dict:
    seen = json.loads((root / "meta" / "splits.json").read_text())["category_balanced"]["seen"]["episodes"]
    data = LeRobotDataset("test/pairs", root=root, episodes=seen, video_backend="pyav")
    first, last = data[0], data[len(data) - 1]
    return {
        "fps": data.fps,
        "robot": data.meta.robot_type,
        "frames": len(data),
        "names": [data.features[name]["names"] for name in ("observation.state", "action")],
        "cameras": sorted(data.meta.camera_keys),
        "state": [item["observation.state"].tolist() for item in (first, last)],
        "action": [item["action"].tolist() for item in (first, last)],
        "is_demonstration": [bool(item["is_demonstration"]) for item in (first, last)],
        "task": [item["task"] for item in (first, last)],
        "shades": [
            {key: round(float(255 * item[key].mean())) for key in data.meta.camera_keys} for item in (first, last)
        ],
        "statistics": [len(data.meta.stats[name]["q01"]) for name in ("observation.state", "action")],
    }


if __name__ == "__main__":
    verb, place = sys.argv[1], Path(sys.argv[2])
    if verb == "write":
        videos, others = write(place / "videos", "video", 0), write(place / "others", "video", 1)
        write(place / "pictures", "image", 0)
        delete_episodes(videos, [1], output_dir=place / "cut", repo_id="test/cut")
        merge_datasets([videos, others], output_repo_id="test/merged", output_dir=place / "merged")
    else:
        told = {"read": read, "rows": rows, "pairs": pairs}[verb](place)
        sys.stdout.write(json.dumps(told, default=str) + "\n")
