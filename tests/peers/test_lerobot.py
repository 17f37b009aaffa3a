"""LeRobot itself writes folders that we import and train on, and reads what we write. `make peers` runs this.

LEROBOT_PYTHON: a Python that has lerobot 0.6 (Makefile).
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.commands import collect
from dual_system.data.dataset import Dataset
from dual_system.data.episode import About, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.paired import PANDA_OMRON, Instant, pack_pair, write_splits
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.training import train

pytestmark = pytest.mark.peers

SCRIPT = Path(__file__).with_name("lerobot_folders.py")
PX, LENGTHS = 256, (31, 24, 27)
MAPPING = """
subgoal = "subgoal"
cameras = {front = "observation.images.top", wrist = "observation.images.hand"}
state = {column = "observation.state", closed = 0.0, opened = 0.04}
action = {column = "action", closed = -1.0, opened = 1.0}
"""


def lerobot(*arguments: str) -> str:
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("LEROBOT_PYTHON is not set; make peers sets it")
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}
    done = subprocess.run([python, str(SCRIPT), *arguments], capture_output=True, text=True, env=outside, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("lerobot")
    lerobot("write", str(root))
    (root / "mapping.toml").write_text(MAPPING)
    return root


def imported(theirs: Path, name: str, out: Path) -> Dataset:
    options = ["--mapping", str(theirs / "mapping.toml"), "--out", str(out), "--no-progress"]
    assert collect(["import", str(theirs / name), *options]) == 0
    return Dataset(out)


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("videos", [0, 1, 2]), ("pictures", [0, 1, 2]), ("cut", [0, 2]), ("merged", [0, 1, 2, 0, 1, 2])],
)
def test_what_lerobot_wrote_is_imported(theirs: Path, tmp_path: Path, name: str, numbers: list[int]) -> None:
    data = imported(theirs, name, tmp_path / "set")
    assert [entry.num_rows for entry in data.episodes] == [2 * LENGTHS[number] for number in numbers]
    assert [entry.instruction for entry in data.episodes] == [f"pick number {number}" for number in numbers]
    for entry, number in zip(data.episodes, numbers, strict=True):
        rows, half = data.rows(entry.index), LENGTHS[number] // 2
        np.testing.assert_array_equal(np.flatnonzero(rows.is_transition), [0, 2 * half])
        shown = data.frames(entry.index, "front", [0, 2 * half]).astype(int)[:, PX // 2, PX // 2, 0]
        assert np.abs(shown - [20, 20 + 5 * half]).max() <= 4
        # An action of these folders is the next row's state.
        np.testing.assert_array_equal(rows.action[0:-2:2, :7], rows.state[2::2, :7])


def test_an_imported_folder_trains_three_steps(theirs: Path, tmp_path: Path) -> None:
    imported(theirs, "merged", tmp_path / "set")
    options = ["--recipe", "tiny", "--data", str(tmp_path / "set"), "--out", str(tmp_path / "run"), "--steps", "3"]
    assert train.main([*options, "--max-invocations", "2", "--no-progress"]) == 0
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log] == [0, 1, 2]
    assert min(line["num_supervised"] for line in log) > 0
    assert not load_ponder(tmp_path / "run" / "ponder").is_random


def test_lerobot_reads_what_we_write(theirs: Path, tmp_path: Path) -> None:
    imported(theirs, "videos", tmp_path / "set")
    found: dict[str, Any] = json.loads(lerobot("read", str(tmp_path / "set")).splitlines()[-1])
    assert (found["episodes"], found["frames"]) == (3, 2 * sum(LENGTHS))
    assert (found["language"], found["task"], found["picture"]) == (True, "pick number 2", [3, PX, PX])
    said = [(row["role"], row["style"], row["content"], row["timestamp"]) for row in found["persistent"]]
    assert said == [("assistant", "subtask", "reach it", 0.0), ("assistant", "subtask", "lift it", 1.5)]
    assert found["events"] == []


def test_lerobot_reads_pairs_of_two_bodies_and_a_split_of_them(tmp_path: Path) -> None:
    tasks = ("OpenDrawer", "CloseDrawer", "TurnOffStove")  # the second is held out
    writer, rng = DatasetWriter(tmp_path, PANDA_OMRON), np.random.default_rng(0)
    demo = [np.full((128, 128, 3), 30 + index, np.uint8) if index % 20 == 0 else None for index in range(21)]
    views = {name: np.full((128, 128, 3), 100 + 40 * place, np.uint8) for place, name in enumerate(PANDA_OMRON.cameras)}
    done = [
        Instant(state=rng.uniform(-1, 1, 53).astype(np.float32), action=rng.uniform(-1, 1, 12).astype(np.float32),
                frames=views)
        for _ in range(10)
    ]  # fmt: skip
    for seed, task in enumerate(tasks):
        about = About(task=task, instruction=f"do {task}", seed=seed, difficulty="", origin="script", is_success=True,
                      image_px=128)  # fmt: skip
        writer.add(unpack(pack_pair(demo, done, about)))
    writer.finish()
    write_splits(tmp_path, tasks)
    found: dict[str, Any] = json.loads(lerobot("pairs", str(tmp_path)).splitlines()[-1])
    assert (found["fps"], found["robot"], found["frames"]) == (20, "panda_omron", 2 * (21 + 10))
    assert found["names"] == [list(PANDA_OMRON.state), list(PANDA_OMRON.action)]
    assert found["statistics"] == [53, 12]
    assert found["cameras"] == sorted(f"observation.images.{name}" for name in PANDA_OMRON.videos)
    assert found["task"] == ["do OpenDrawer", "do TurnOffStove"]
    assert found["is_demonstration"] == [True, False]
    np.testing.assert_allclose(found["state"], [done[0].state, done[-1].state], atol=1e-6)
    np.testing.assert_allclose(found["action"], [done[0].action, done[-1].action], atol=1e-6)
    shown, acted = found["shades"]
    assert abs(shown["observation.images.demonstration"] - 30) <= 3
    for place, name in enumerate(PANDA_OMRON.cameras):
        assert shown[f"observation.images.{name}"] <= 3  # black while another body shows it
        assert abs(acted[f"observation.images.{name}"] - (100 + 40 * place)) <= 3
