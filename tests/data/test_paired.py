"""Paired episodes: what was shown and done is what is read, by our reader; `make peers` asks LeRobot the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dual_system.data.dataset import Dataset
from dual_system.data.episode import DEMO_CAMERA, About, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.paired import HELD_OUT, PANDA_OMRON, SPLITS_PATH, Instant, pack_pair, write_splits
from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.layout import NUM_ACTION, NUM_STATE
from dual_system.training.data import TrainingSet

PX, NUM_DEMO, NUM_TICKS, WORDS = 64, 3, 25, "open the drawer on the left"
ABOUT = About(
    task="OpenDrawer", instruction="open the left drawer", seed=0, difficulty="", origin="script", is_success=True,
    image_px=PX,
)  # fmt: skip


def shade(value: int) -> np.ndarray:
    return np.full((PX, PX, 3), value, np.uint8)


DEMO = [shade(20 + index) if index % 20 == 0 else None for index in range(20 * (NUM_DEMO - 1) + 1)]
"""Three frames at 1 Hz."""


def execution(seed: int) -> list[Instant]:
    rng = np.random.default_rng(seed)
    return [
        Instant(
            state=rng.uniform(-1, 1, NUM_STATE).astype(np.float32),
            action=rng.uniform(-1, 1, NUM_ACTION).astype(np.float32),
            frames={name: shade(100 + 40 * place) for place, name in enumerate(PANDA_OMRON.cameras)},
        )
        for _ in range(NUM_TICKS)
    ]


def write(root: Path, tasks: list[str]) -> Path:
    writer = DatasetWriter(root, PANDA_OMRON)
    for seed, task in enumerate(tasks):
        writer.add(unpack(pack_pair(DEMO, execution(seed), replace(ABOUT, task=task, seed=seed), words=WORDS)))
    writer.finish()
    write_splits(root, tasks)
    return root


def test_a_pair_is_read_as_it_was_done(tmp_path: Path) -> None:
    dataset = Dataset(write(tmp_path / "set", ["OpenDrawer", "CloseDrawer"]))
    assert dataset.described["robot_type"] == "panda_omron"
    assert (dataset.cameras, dataset.demo_cameras) == (PANDA_OMRON.cameras, (DEMO_CAMERA,))
    for entry in dataset.episodes:
        start, rows, done = entry.num_demonstration_rows, dataset.rows(entry.index), execution(entry.seed)
        assert (start, entry.num_rows) == (41, 41 + NUM_TICKS)  # three frames at 1 Hz are 2.05 s
        np.testing.assert_array_equal(rows.state[start:], [each.state for each in done])
        np.testing.assert_array_equal(rows.action[start:], [each.action for each in done])
        np.testing.assert_array_equal(rows.state[:start], np.tile(done[0].state, (start, 1)))
        np.testing.assert_array_equal(np.flatnonzero(rows.is_rendered[:start]), [0, 20, 40])
        shown = [[views.mean() for views in each] for each in dataset.views(entry, [0, 20, 40])]
        np.testing.assert_allclose(shown, [[20], [40], [60]], atol=3)
        assert rows.grounded_subgoal == ("",) * start + (WORDS,) * NUM_TICKS
        np.testing.assert_array_equal(np.flatnonzero(rows.is_transition), [start])
        (seen,) = dataset.views(entry, [start])
        np.testing.assert_allclose([view.mean() for view in seen], [100, 140, 180], atol=3)


def test_an_execution_may_come_without_a_demonstration() -> None:
    rows = unpack(pack_pair([], execution(0), ABOUT)).rows
    assert len(rows) == NUM_TICKS
    assert not rows.is_demonstration.any()


def test_statistics_are_of_the_execution_alone(tmp_path: Path) -> None:
    data = TrainingSet(write(tmp_path / "set", ["OpenDrawer"]))
    done = np.array([each.state for each in execution(0)])
    statistics = data.statistics(horizon=16, space="native")
    np.testing.assert_allclose(statistics.state.q01, np.quantile(done.astype(np.float64), 0.01, axis=0), atol=1e-6)
    sampling = data.demo_sampling()
    assert sampling is not None
    assert (sampling.hz, sampling.num_views) == (1, 1)


@pytest.mark.parametrize("name", HELD_OUT)
def test_a_split_parts_the_tasks_and_their_episodes(tmp_path: Path, name: str) -> None:
    tasks = [*TASKS, "CloseDrawer", "OpenDrawer"]
    (tmp_path / "meta").mkdir()
    write_splits(tmp_path, tasks)
    parts = json.loads((tmp_path / SPLITS_PATH).read_text())[name]
    assert (len(parts["seen"]["tasks"]), len(parts["unseen"]["tasks"])) == (19, 5)
    assert set(parts["unseen"]["tasks"]) == set(HELD_OUT[name])
    assert sorted(parts["seen"]["episodes"] + parts["unseen"]["episodes"]) == list(range(26))
    for part in parts.values():
        assert {tasks[index] for index in part["episodes"]} == set(part["tasks"])


def test_training_on_a_split_sees_no_held_out_task(tmp_path: Path) -> None:
    root = write(tmp_path / "set", ["OpenDrawer", "CloseDrawer", "TurnOffStove"])
    seen = json.loads((root / SPLITS_PATH).read_text())["category_balanced"]["seen"]["tasks"]
    assert [task for task, _ in TrainingSet(root, tasks=seen).names] == ["OpenDrawer", "TurnOffStove"]


def test_what_is_no_pair_is_refused() -> None:
    with pytest.raises(ValueError, match="OpenDrawer 0: an execution without an instant"):
        pack_pair([shade(1)], [], ABOUT)
    with pytest.raises(ValueError, match="OpenDrawer 0: the demonstration's first row has no frame"):
        pack_pair([None, shade(1)], execution(0), ABOUT)
    with pytest.raises(ValueError, match="expected 53 numbers of state and 12 of action, came 53 and 8"):
        pack_pair([], [replace(execution(0)[0], action=np.zeros(8, np.float32))], ABOUT)
