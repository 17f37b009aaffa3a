"""A v3 folder as LeRobot's tools leave it: every episode has its own rows and frames, or the folder is refused."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dual_system.data import card
from dual_system.data import lerobot_files as layout
from dual_system.data import lerobot_v3 as v3
from dual_system.data.dataset import Dataset
from dual_system.data.episode import Episode, Package, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.video import read_frames

LENGTHS = (5, 9, 4)
DATA = layout.DATA_PATH.format(chunk_index=0, file_index=0)
VIDEO = layout.VIDEO_PATH.format(video_key=layout.video_key("front"), chunk_index=0, file_index=0)
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 7\n"


@pytest.fixture(scope="module")
def episodes(package: Callable[..., Package]) -> list[Episode]:
    return [unpack(package(seed, num_rows=length)) for seed, length in enumerate(LENGTHS)]


def write(root: Path, episodes: list[Episode]) -> Path:
    writer = v3.DatasetWriter(root)
    for episode in episodes:
        writer.add(episode)
    writer.finish()
    return root


@pytest.fixture(scope="module")
def base(episodes: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("base"), episodes)


@pytest.fixture
def folder(base: Path, tmp_path: Path) -> Path:
    return shutil.copytree(base, tmp_path / "set")


def assert_own_rows_and_frames(folder: Path, base: Path) -> Dataset:
    """Episodes are recognised by their seed."""
    original, found = Dataset(base), Dataset(folder)
    for entry in found.episodes:
        expected, rows = original.rows(entry.seed), found.rows(entry.index)
        np.testing.assert_array_equal(rows.state, expected.state)
        assert rows.state.dtype == np.float32
        assert rows.grounded_subgoal == expected.grounded_subgoal
        last = [0, entry.num_rows - 1]
        frames, theirs = (
            each.frames(index, "front", last) for each, index in ((found, entry.index), (original, entry.seed))
        )
        np.testing.assert_array_equal(frames, theirs)
    return found


def edit_info(folder: Path, **changes: Any) -> None:
    path = folder / layout.INFO_PATH
    values = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in values.items() if value is not None}))


def listed(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(folder / layout.EPISODES_PATH).to_pylist()
    return found


def edit_episodes(folder: Path, edit: Callable[[list[dict[str, Any]]], Any]) -> None:
    rows = listed(folder)
    edit(rows)
    pq.write_table(
        pa.Table.from_pylist(rows, schema=pq.read_schema(folder / layout.EPISODES_PATH)), folder / layout.EPISODES_PATH
    )


# -- names


@given(name=st.text("a1:#%? ü[]{}&=+", min_size=1, max_size=12))
@example(name="run:1")
@example(name="2026-11-30T10:20")
@settings(max_examples=4)
def test_a_relative_folder_of_any_name_is_written_and_read_as_a_plain_one(
    base: Path, episodes: list[Episode], name: str
) -> None:
    with tempfile.TemporaryDirectory() as around, chdir(around):
        write(Path(name), episodes)
        written, expected = (
            {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
            for root in (Path(name), base)
        )
        assert written == expected
        assert_own_rows_and_frames(Path(name), base)


# -- layouts that are right


def test_the_end_of_a_file_is_read_once_however_many_episodes_it_holds(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names every group of rows, one an episode: read for each of them, a folder takes the square of its length."""
    read: list[Path] = []
    opened, read_metadata = pq.ParquetFile, pq.read_metadata

    def counted(path: Path) -> Any:
        read.append(path)
        return read_metadata(path)

    def counted_unless_known(path: Path, **options: Any) -> Any:
        read.extend([path] * ("metadata" not in options))
        return opened(path, **options)

    monkeypatch.setattr(pq, "read_metadata", counted)
    monkeypatch.setattr(pq, "ParquetFile", counted_unless_known)
    dataset = Dataset(folder)
    for entry in dataset.episodes:
        dataset.rows(entry.index)
    assert sorted(read) == sorted(each for each in folder.rglob("*.parquet") if each.name != "tasks.parquet")


@pytest.mark.parametrize("row_group_size", [1, 7, 100])
def test_row_groups_mean_nothing(folder: Path, base: Path, row_group_size: int) -> None:
    pq.write_table(pq.read_table(folder / DATA), folder / DATA, row_group_size=row_group_size)
    assert_own_rows_and_frames(folder, base)


def test_rows_may_be_those_of_pandas(folder: Path, base: Path) -> None:
    table = pq.read_table(folder / DATA)
    kinds = {"observation.state": pa.list_(pa.float64()), "subgoal": pa.large_string()}
    for name, kind in kinds.items():
        table = table.set_column(table.column_names.index(name), name, table[name].cast(kind))
    pq.write_table(table, folder / DATA)
    assert_own_rows_and_frames(folder, base)


def test_episodes_may_be_listed_in_several_files_and_chunks(folder: Path, base: Path) -> None:
    table = pq.read_table(folder / layout.EPISODES_PATH)
    for name, begin in (("chunk-000/file-000", 0), ("chunk-000/file-001", 1), ("chunk-001/file-000", 2)):
        path = folder / "meta" / "episodes" / f"{name}.parquet"
        path.parent.mkdir(exist_ok=True)
        pq.write_table(table.slice(begin, 1), path)
    assert len(assert_own_rows_and_frames(folder, base).episodes) == 3


@pytest.mark.parametrize("kept", [[0, 2], [1, 2], [2, 0]])
def test_episodes_may_be_taken_out_and_leave_a_gap(folder: Path, base: Path, kept: list[int]) -> None:
    pq.write_table(pq.read_table(folder / layout.EPISODES_PATH).take(kept), folder / layout.EPISODES_PATH)
    assert [each.index for each in assert_own_rows_and_frames(folder, base).episodes] == kept


def test_rows_may_be_rewritten_and_numbered_anew(folder: Path, base: Path) -> None:
    table = pq.read_table(folder / DATA)
    table = table.filter(pa.array(np.asarray(table["episode_index"]) != 1))
    anew = {"episode_index": np.repeat([0, 1], [5, 4]), "index": np.arange(9)}
    for name, values in anew.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, folder / DATA)

    def renumber(rows: list[dict[str, Any]]) -> None:
        del rows[1]
        rows[1] |= {"episode_index": 1, "dataset_from_index": 5, "dataset_to_index": 9}

    edit_episodes(folder, renumber)
    assert_own_rows_and_frames(folder, base)


@pytest.mark.parametrize("codec", ["libx265", "libsvtav1", "libvpx-vp9"])
def test_frames_of_other_codecs_are_the_same_instants(tmp_path: Path, codec: str) -> None:
    """With few key frames and frames that are stored out of order."""
    path, shades = tmp_path / "a.mp4", [20 + 5 * number for number in range(40)]
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=10)
        stream.width = stream.height = 64
        stream.pix_fmt, stream.options = "yuv420p", {"g": "30", "x265-params": "log-level=0:bframes=3"}
        for shade in shades:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), shade, np.uint8))))
        container.mux(stream.encode())
    wanted = [0, 1, 13, 29, 31, 39]
    means = [frame.mean() for frame in read_frames(path, wanted, fps=10)]
    assert means == pytest.approx([shades[index] for index in wanted], abs=2)


# -- tables that contradict each other


def raise_length(rows: list[dict[str, Any]]) -> None:
    rows[0]["length"] += 3


def take_from_the_next(rows: list[dict[str, Any]]) -> None:
    rows[0] |= {"length": 6, "dataset_to_index": 6}


def point_at_another(rows: list[dict[str, Any]]) -> None:
    rows[0] |= {"length": 9, "dataset_from_index": 5, "dataset_to_index": 14}


def share_frames(rows: list[dict[str, Any]]) -> None:
    rows[1][f"videos/{layout.video_key('wrist')}/from_timestamp"] -= 0.05
    rows[1][f"videos/{layout.video_key('wrist')}/to_timestamp"] -= 0.05


def double(rows: list[dict[str, Any]]) -> None:
    rows[1]["episode_index"] = 0


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (raise_length, "gives episode 0 8 rows, and the numbers 0 to 5 .*, which are 5"),
        (point_at_another, r"gives episode 0 9 rows, and 5\.0 frames of observation"),
        (take_from_the_next, r"episode 0 has the frames 0 to 5, and episode 1 begins at 5"),
        (share_frames, r"wrist.*episode 0 has the frames 0 to 4, and episode 1 begins at 4"),
        (double, "3 episodes with 2 different numbers"),
        (lambda rows: rows[2].update(length=None), "expected a number for length, came None"),
        (lambda rows: rows[2].update({"data/file_index": 3}), "file-003.parquet cannot be read: No such file"),
        (lambda rows: rows[2].update(num_demonstration_rows=4), "4 of 4 rows of episode 2 are a demonstration"),
        (lambda rows: rows.clear(), "lists no episode"),
        (lambda rows: rows[1].update(tasks=[]), "expected tasks of type list"),
    ],
)
def test_a_listing_that_cannot_be_is_refused(
    folder: Path, edit: Callable[[list[dict[str, Any]]], Any], said: str
) -> None:
    edit_episodes(folder, edit)
    with pytest.raises(DatasetError, match=said):
        Dataset(folder)


@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("episode_index", lambda values: values + 1, "episode 0 has the rows 0 to 4; these are of episode 1"),
        ("index", lambda values: values + 2, "episode 0 has the rows 0 to 4, which are 5; there are 3"),
        ("index", lambda values: values[[1, 0, *range(2, 18)]], "their index does not ascend by one"),
        ("frame_index", lambda values: values + 1, "their frame_index is not 0 to 4"),
        ("timestamp", lambda values: ["soon"] * len(values), "cannot be read: .*'soon'"),
        ("timestamp", lambda values: values * np.float32(0.5), r"number 4 is at 0\.100 s, not 0\.200 s"),
    ],
)
def test_rows_that_are_not_the_listed_ones_are_refused(
    folder: Path, column: str, change: Callable[[Any], Any], said: str
) -> None:
    table = pq.read_table(folder / DATA)
    values = pa.array(change(table[column].to_numpy()))
    pq.write_table(table.set_column(table.column_names.index(column), column, values), folder / DATA)
    with pytest.raises(DatasetError, match=said):
        Dataset(folder).rows(0)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", ["observation.state", "action", "tcp_pose"])
def test_a_number_that_is_not_finite_is_refused_with_episode_and_row(folder: Path, column: str, number: float) -> None:
    table = pq.read_table(folder / DATA)
    values = table[column].to_pylist()
    values[LENGTHS[0] + 7][3] = number
    column_of = pa.array(values, table.schema.field(column).type)
    pq.write_table(table.set_column(table.column_names.index(column), column, column_of), folder / DATA)
    dataset = Dataset(folder)
    assert len(dataset.rows(0)) == LENGTHS[0]
    with pytest.raises(DatasetError, match=rf"{folder}: episode 1: column .* has {number} in row 7, place 3"):
        dataset.rows(1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"codebase_version": "v2.1"}, r"version v2\.1, and v3\.0 is read\. LeRobot converts"),
        *(({"codebase_version": each}, rf"{each}, and v3\.0 is read\. No way") for each in ("v3.1", "v4.0", "3.0", "")),
        ({"codebase_version": None}, "expected 'codebase_version' of type str, came nothing"),
        ({"features": None}, "expected 'features' of type dict"),
        ({"features": {}}, "no camera's videos; expected features"),
        ({"fps": None}, "expected 'fps'"),
        ({"fps": 30}, r"5 rows, and 7\.5 frames"),
        ({"data_path": "../{episode}"}, "expected 'data/chunk-"),
    ],
)
def test_an_info_json_of_something_else_is_refused(folder: Path, changes: dict[str, Any], said: str) -> None:
    edit_info(folder, **changes)
    with pytest.raises(DatasetError, match=said):
        Dataset(folder)


@pytest.mark.parametrize(
    "column", ["episode_index", "dataset_to_index", f"videos/{layout.video_key('wrist')}/from_timestamp"]
)
def test_a_listing_without_lerobot_s_columns_is_refused(folder: Path, column: str) -> None:
    table = pq.read_table(folder / layout.EPISODES_PATH)
    pq.write_table(table.drop_columns([column]), folder / layout.EPISODES_PATH)
    with pytest.raises(DatasetError, match=f"expected a number for {column}, came None"):
        Dataset(folder)


def test_a_dataset_of_lerobot_s_own_columns_is_not_ours(folder: Path) -> None:
    table = pq.read_table(folder / layout.EPISODES_PATH)
    pq.write_table(table.drop_columns(["seed", "difficulty"]), folder / layout.EPISODES_PATH)
    with pytest.raises(DatasetError, match="not one of ours: meta/episodes lacks difficulty, seed"):
        Dataset(folder)


# -- broken files


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("name", [layout.INFO_PATH, layout.EPISODES_PATH, DATA, VIDEO])
@pytest.mark.parametrize(
    "damage", [cut, Path.unlink, lambda path: path.write_text(POINTER)], ids=["cut", "gone", "lfs"]
)
def test_a_broken_file_is_named(
    folder: Path, name: str, damage: Callable[[Path], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(folder / name)
    assert card.main([str(folder)]) == 2
    said = capsys.readouterr().err
    assert (name if name != layout.EPISODES_PATH else "meta/episodes") in said
    assert "Traceback" not in said


def test_a_parquet_file_that_declares_too_much_is_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dual_system.data.lerobot_folder.MAX_FILE_ROWS", 17)
    with pytest.raises(DatasetError, match=r"declares 18 rows of \d+ bytes; at most 17"):
        Dataset(folder)


@pytest.mark.parametrize("name", [layout.EPISODES_PATH, DATA])
def test_a_text_that_is_repeated_without_end_is_not_spelled_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("dual_system.data.lerobot_folder.MAX_TEXT_BYTES", 2000)
    table = pq.read_table(folder / name)
    column = "difficulty" if name == layout.EPISODES_PATH else "subgoal"
    texts = pa.array(["x" * 1000] * len(table))
    pq.write_table(table.set_column(table.column_names.index(column), column, texts), folder / name)
    with pytest.raises(DatasetError, match=r"its texts have \d+ bytes, at most 2000"):
        Dataset(folder).rows(0)
