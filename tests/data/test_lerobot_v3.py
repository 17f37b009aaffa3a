"""The v3 folder: what its tables say is where things are, whatever files they are spread over."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from dual_system.data import lerobot_files as layout
from dual_system.data import lerobot_v3 as v3
from dual_system.data.dataset import Dataset
from dual_system.data.episode import CAMERAS, EXECUTED, Episode, Package, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.video import read_frames

LENGTHS = (5, 9, 4)


@pytest.fixture(scope="module")
def episodes(package: Callable[..., Package]) -> list[Episode]:
    return [unpack(package(seed, num_rows=length)) for seed, length in enumerate(LENGTHS)]


@pytest.fixture(scope="module", params=[100, 0], ids=["one file", "a file each"])
def dataset(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]
) -> Dataset:
    root = tmp_path_factory.mktemp("v3")
    writer = v3.DatasetWriter(root, data_file_mb=request.param, video_file_mb=request.param)
    for episode in episodes:
        writer.add(episode)
    writer.finish()
    return Dataset(root)


def test_rows_come_back_as_they_were(dataset: Dataset, episodes: list[Episode]) -> None:
    for index, episode in enumerate(episodes):
        rows = dataset.rows(index)
        np.testing.assert_array_equal(rows.state, episode.rows.state)
        np.testing.assert_array_equal(rows.action, episode.rows.action)
        np.testing.assert_array_equal(rows.is_transition, episode.rows.is_transition)
        assert rows.demonstration_reasoning == episode.rows.demonstration_reasoning


def test_pictures_are_those_of_the_episode_s_own_video(
    dataset: Dataset, episodes: list[Episode], tmp_path: Path
) -> None:
    for index, episode in enumerate(episodes):
        for camera in CAMERAS:
            alone = tmp_path / "alone.mp4"
            alone.write_bytes(episode.videos[camera])
            wanted = [0, 1, LENGTHS[index] - 1]
            expected = np.stack(list(read_frames(alone, wanted)))
            np.testing.assert_array_equal(dataset.frames(index, camera, wanted), expected)


def test_rows_that_are_not_there_are_refused(dataset: Dataset) -> None:
    with pytest.raises(IndexError, match="of 5 rows"):
        dataset.frames(0, "front", [3, 5])


def test_the_numbers_that_lerobot_counts_by(dataset: Dataset) -> None:
    table = pq.read_table(dataset.root / "data").sort_by("index")
    assert table["index"].to_pylist() == list(range(sum(LENGTHS)))
    assert table["episode_index"].to_pylist() == [0] * 5 + [1] * 9 + [2] * 4
    assert table["frame_index"].to_pylist() == [*range(5), *range(9), *range(4)]
    np.testing.assert_allclose(table["timestamp"].to_numpy(), table["frame_index"].to_numpy() / 20)
    assert table["task_index"].to_pylist() == [0] * 5 + [1] * 9 + [0] * 4


def test_the_folder_describes_itself(dataset: Dataset) -> None:
    described = json.loads((dataset.root / layout.INFO_PATH).read_text())
    listed = pq.read_table(dataset.root / layout.EPISODES_PATH).to_pylist()
    assert described["codebase_version"] == "v3.0"
    assert (described["total_episodes"], described["total_frames"], described["total_tasks"]) == (3, 18, 2)
    assert [(each["dataset_from_index"], each["dataset_to_index"]) for each in listed] == [(0, 5), (5, 14), (14, 18)]
    stored = set(pq.read_table(dataset.root / "data").column_names)
    features = described["features"]
    assert stored == {name for name, feature in features.items() if feature["dtype"] != "video"}
    for each in listed:
        for camera in CAMERAS:
            key = layout.video_key(camera)
            place = {name: each[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            assert (dataset.root / described["video_path"].format(video_key=key, **place)).exists()


def test_instructions_are_found_by_their_text(dataset: Dataset) -> None:
    table = pq.read_table(dataset.root / layout.TASKS_PATH)
    assert table.to_pydict() == {"task_index": [0, 1], "task": ["count to 0", "count to 1"]}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_statistics_of_actions_leave_demonstrations_out(dataset: Dataset, episodes: list[Episode]) -> None:
    found = json.loads((dataset.root / layout.STATS_PATH).read_text())
    own = np.concatenate([episode.rows.action[~episode.rows.is_demonstration] for episode in episodes])
    np.testing.assert_allclose(found["action"]["mean"], own.astype(np.float64).mean(0))
    assert found["action"]["count"] == [len(own)] == [12]
    assert found["frame_index"]["count"] == [18]
    every = [value for of in found.values() for values in of.values() for value in np.ravel(values)]
    assert np.isfinite(every).all()


def test_what_was_executed_under_noise_is_a_column_of_its_own(package: Callable[..., Package], tmp_path: Path) -> None:
    writer = v3.DatasetWriter(tmp_path)
    for seed, nudge_rad in ((1, 0.0), (2, 0.25)):
        writer.add(unpack(package(seed, nudge_rad=nudge_rad, noise_rad=nudge_rad)))
    writer.finish()
    dataset = Dataset(tmp_path)
    assert [each.noise_rad for each in dataset.episodes] == [0.0, 0.25]
    clean, noisy = dataset.rows(0), dataset.rows(1)
    assert clean.executed_action is not None
    assert noisy.executed_action is not None
    np.testing.assert_array_equal(clean.executed_action, clean.action)
    own = ~noisy.is_demonstration
    np.testing.assert_array_equal(noisy.executed_action[own], noisy.action[own] + np.float32(0.25))
    np.testing.assert_array_equal(noisy.executed_action[~own], noisy.action[~own])
    features = dataset.described["features"]
    assert features[EXECUTED] == features["action"]
    assert set(pq.read_table(tmp_path / "data").column_names) == {
        name for name, feature in features.items() if feature["dtype"] != "video"
    }
    found = json.loads((tmp_path / layout.STATS_PATH).read_text())
    assert found[EXECUTED]["count"] == found["action"]["count"] == [6]
    assert found[EXECUTED]["mean"] != found["action"]["mean"]


def test_a_dataset_without_noise_has_no_such_column(dataset: Dataset) -> None:
    assert EXECUTED not in dataset.described["features"]
    assert "noise_rad" not in pq.read_table(dataset.root / layout.EPISODES_PATH).column_names
    assert dataset.rows(0).executed_action is None
    assert {each.noise_rad for each in dataset.episodes} == {0.0}


def test_all_episodes_say_what_was_executed_or_none_does(package: Callable[..., Package], tmp_path: Path) -> None:
    writer = v3.DatasetWriter(tmp_path)
    writer.add(unpack(package(1)))
    with pytest.raises(ValueError, match="all have executed_action, or none has"):
        writer.add(unpack(package(2, nudge_rad=0.25)))


def test_one_dataset_has_one_picture_size(package: Callable[..., Package], tmp_path: Path) -> None:
    writer = v3.DatasetWriter(tmp_path)
    writer.add(unpack(package(1)))
    with pytest.raises(ValueError, match="32 px after ones of 16 px"):
        writer.add(unpack(package(1, image_px=32)))


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="pp-collect makes one"):
        Dataset(tmp_path)


def test_rerun_s_reader_reads_every_row_and_text(dataset: Dataset) -> None:
    experimental = pytest.importorskip("rerun.experimental", reason="rerun-sdk is not installed")
    reader = experimental.LeRobotReader(str(dataset.root))
    assert (reader.version, reader.episodes()) == ("v3", [0, 1, 2])
    for episode, length in enumerate(LENGTHS):
        num_rows = {"/action": 0, "/subgoal": 0, "/demonstration_reasoning": 0}
        for chunk in reader.stream(episode):
            if chunk.entity_path in num_rows and not chunk.is_static:
                num_rows[chunk.entity_path] += chunk.num_rows
        assert set(num_rows.values()) == {length}
