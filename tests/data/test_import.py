"""Recordings of others become rows of ours: nothing is shifted, invented or taken for something else in silence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.data.dataset import Dataset
from dual_system.data.episode import Package, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.import_sets import ImportOptions, as_ours, import_sets
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.mapping import FINGER_M, GRIPPER, ROBOMME, Arm, read_mapping
from dual_system.data.source import NO_PICTURE, SourceEpisode, at_20_hz, in_force, paired

OURS = """
demonstration = "is_demonstration"
subgoal = "subgoal"
grounded_subgoal = "grounded_subgoal"
cameras = {front = "observation.images.front", wrist = "observation.images.wrist"}
state = {column = "observation.state", closed = 0.0, opened = 0.04}
action = {column = "action", closed = -1.0, opened = 1.0}
"""


def episode(num_rows: int, **changes: Any) -> SourceEpisode:
    """State k is (k, k, ...), action k is 100 + k, and so are the brightness and the text of row k."""
    numbers = np.arange(num_rows, dtype=np.float32)
    values: dict[str, Any] = {
        "task": "T",
        "instruction": "do it",
        "number": 3,
        "rows_hz": 20,
        "state_T8": np.repeat(numbers[:, None], 8, axis=1),
        "action_T8": np.repeat(100 + numbers[:, None], 8, axis=1),
        "subgoal": tuple(f"s{row}" for row in range(num_rows)),
        "grounded_subgoal": tuple(f"g{row}" for row in range(num_rows)),
        "is_demonstration_T": np.zeros(num_rows, np.bool_),
        "frames": lambda camera, rows: np.stack([np.full((16, 16, 3), 10 * row, np.uint8) for row in rows]),
    }
    return SourceEpisode(**values | changes)


@pytest.fixture
def folder(package: Callable[..., Package], tmp_path: Path) -> Path:
    writer = DatasetWriter(tmp_path / "set")
    for seed in range(3):
        writer.add(unpack(package(seed, num_rows=6 + seed)))
    writer.finish()
    return tmp_path / "set"


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    path = tmp_path / "mapping.toml"
    path.write_text(OURS)
    return path


# -- laws of time


@given(rows=st.integers(2, 60), times=st.sampled_from([1, 2, 4, 5, 10, 20]))
def test_a_slower_recording_has_its_own_rows_and_nothing_else_but_states_between_them(rows: int, times: int) -> None:
    found = at_20_hz(episode(rows, rows_hz=20 / times))
    assert len(found.state_N8) == rows * times
    np.testing.assert_allclose(found.state_N8[::times, 0], np.arange(rows))
    assert (np.diff(found.state_N8[:, 0]) >= 0).all()
    assert found.state_N8[:, 0].max() == rows - 1  # not beyond what was measured
    np.testing.assert_array_equal(found.action_N8[:, 0], 100 + np.repeat(np.arange(rows), times))
    np.testing.assert_array_equal(found.label_N, np.repeat(np.arange(rows), times))
    shown = found.picture_N != NO_PICTURE
    np.testing.assert_array_equal(np.flatnonzero(shown), np.arange(rows) * times)
    np.testing.assert_array_equal(found.picture_N[shown], np.arange(rows))


@given(rows=st.integers(2, 60), times=st.sampled_from([1, 2, 3, 5]))
def test_a_faster_recording_gives_every_nth_row_and_the_command_before_the_next(rows: int, times: int) -> None:
    found = at_20_hz(episode(rows, rows_hz=20 * times))
    assert len(found.state_N8) == rows // times
    np.testing.assert_array_equal(found.state_N8[:, 0], np.arange(rows // times) * times)
    np.testing.assert_array_equal(found.action_N8[:, 0] - 100, found.state_N8[:, 0] + times - 1)
    np.testing.assert_array_equal(found.picture_N, found.label_N)


@pytest.mark.parametrize("hz", [15, 30, 25, 3, 19.98])
def test_another_rate_is_refused_with_the_way_out(hz: float) -> None:
    with pytest.raises(DatasetError, match=rf"{hz:g} rows a second.*rows_hz"):
        at_20_hz(episode(4, rows_hz=hz))


@given(rows=st.integers(2, 40))
def test_what_an_action_led_to_goes_before_the_next_one(rows: int) -> None:
    found = paired(episode(rows), Path("set"))
    np.testing.assert_array_equal(found.action_T8[:, 0] - 100, found.state_T8[:, 0] + 1)
    assert found.subgoal == tuple(f"s{row}" for row in range(1, rows))  # of the action
    assert found.num_rows == rows - 1
    assert found.frames("front", [0])[0, 0, 0, 0] == 0


def test_one_row_has_no_pair() -> None:
    with pytest.raises(DatasetError, match=r"^set: episode \d+: 1 row"):
        paired(episode(1), Path("set"))


# -- what becomes a row


def test_a_subgoal_begins_after_the_demonstration_and_where_its_words_change() -> None:
    source = episode(
        7,
        subgoal=("a", "a", "a", "a", "b", "b", "a"),
        is_demonstration_T=np.arange(7) < 2,
    )
    rows = as_ours(source, 16).rows
    np.testing.assert_array_equal(np.flatnonzero(rows.is_transition), [2, 4, 6])
    assert rows.grounded_subgoal == source.grounded_subgoal


def test_a_demonstration_comes_first_or_is_refused() -> None:
    for flags in ([0, 1, 0], [1, 1, 1]):
        with pytest.raises(DatasetError, match="must come first, and some rows must follow"):
            as_ours(episode(3, is_demonstration_T=np.array(flags, np.bool_)), 16)


def test_pictures_of_any_shape_become_whole_squares() -> None:
    def wide(camera: str, rows: Any) -> Any:
        return np.full((len(rows), 20, 40, 3), 200, np.uint8)

    found = as_ours(episode(3, frames=wide), 32)
    assert found.about.image_px == 32
    # A quarter above and a quarter below are black: the mean of the histogram is half of 200 / 255.
    (mean,) = np.unique(np.round(found.pixels["front"].statistics()["mean"], 2))
    assert mean == pytest.approx(0.39, abs=0.02)


def test_none_keeps_the_subgoal_before_it() -> None:
    assert in_force(["complete", "a", "all complete", "b"], "complete") == ("", "a", "a", "b")
    assert in_force(["a", ""], "") == ("a", "")


@given(
    closed=st.floats(allow_nan=False, allow_infinity=False),
    opened=st.floats(allow_nan=False, allow_infinity=False),
    value=st.floats(),
)
def test_a_row_is_finite_or_refused(closed: float, opened: float, value: float) -> None:
    if closed == opened:
        return
    try:
        found = Arm(column="c", closed=closed, opened=opened).read(np.full((2, 8), value), GRIPPER)
    except ValueError as error:
        assert "column c" in str(error)  # noqa: PT017 - either may happen
    else:
        assert np.isfinite(found).all()


@given(closed=st.floats(-5, 5), opened=st.floats(-5, 5), at=st.floats(0, 1), ours=st.sampled_from([FINGER_M, GRIPPER]))
def test_a_gripper_s_ends_are_ours(closed: float, opened: float, at: float, ours: tuple[float, float]) -> None:
    if abs(closed - opened) < 1e-3:
        return
    values = np.zeros((1, 8))
    values[0, 7] = closed + at * (opened - closed)
    found = Arm(column="c", closed=closed, opened=opened).read(values, ours)[0, 7]
    assert found == pytest.approx(ours[0] + at * (ours[1] - ours[0]), abs=1e-3)


def test_the_stick_has_a_closed_gripper_that_never_moves() -> None:
    found = Arm(column="c", dims=tuple(range(7)), closed=0.0, opened=1.0).read(np.ones((3, 7)), GRIPPER)
    assert found.shape == (3, 8)
    assert (found[:, 7] == -1).all()


# -- folders


def test_export_and_import_are_inverse(folder: Path, mapping: Path, tmp_path: Path) -> None:
    options = ImportOptions(sources=(folder,), out=tmp_path / "again", mapping=mapping, image_px=16, progress=False)
    assert import_sets(options) == (3, 0)
    before, after = Dataset(folder), Dataset(tmp_path / "again")
    for entry, other in zip(before.episodes, after.episodes, strict=True):
        assert (entry.instruction, entry.num_rows, entry.num_demonstration_rows) == (
            other.instruction,
            other.num_rows,
            other.num_demonstration_rows,
        )
        rows, found = before.rows(entry.index), after.rows(other.index)
        for name in ("state", "action", "is_demonstration", "is_transition"):
            np.testing.assert_array_equal(getattr(rows, name), getattr(found, name), err_msg=name)
        assert (rows.subgoal, rows.grounded_subgoal) == (found.subgoal, found.grounded_subgoal)
        for camera in ("front", "wrist"):
            there, here = (
                each.frames(number, camera, range(entry.num_rows)).astype(np.int16)
                for each, number in ((before, entry.index), (after, other.index))
            )
            assert np.abs(there - here).mean() < 10  # noise, encoded once more; another row's differs by 80


def test_a_folder_of_other_columns_says_what_it_has(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no camera 'image', .*column 'state'.*it has action, .*--mapping"):
        import_sets(ImportOptions(sources=(folder,), out=tmp_path / "out", progress=False))


def test_a_dataset_is_not_written_over(folder: Path, mapping: Path) -> None:
    with pytest.raises(DatasetError, match="holds a dataset already"):
        import_sets(ImportOptions(sources=(folder,), out=folder, mapping=mapping, progress=False))


NO_NUMBERS = ("nan", "inf", "-inf", "1" + "0" * 400)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cameras = [", "mapping.toml"),
        ("rows_hz = 20", "missing"),
        (OURS + "colour = 3", "unknown"),
        (OURS.replace("opened = 0.04", "opened = 0.0"), "closed and opened are both"),
        (OURS.replace('column = "action",', 'column = "action", dims = [1, 2],'), "seven joints"),
        (OURS.replace('column = "action",', 'column = "action", dims = [0, 1, 2, 3, 4, 5, 6, 6],'), "each once"),
        *((OURS.replace("closed = 0.0", f"closed = {odd}"), "state.closed: expected a finite") for odd in NO_NUMBERS),
        *((f"rows_hz = {odd}\n{OURS}", "rows_hz: expected a finite number") for odd in NO_NUMBERS),
        *((f"rows_hz = {odd}\n{OURS}", "rows_hz: expected a rate") for odd in ("0", "-20", "1e-300", "1001")),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_by_name(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mapping.toml"
    path.write_text(text)
    with pytest.raises((DatasetError, ValueError), match=said) as error:
        read_mapping(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.full((2, 8), np.nan), "state .* has nan in row 0"),
        (np.zeros((2, 5)), "place 7 of it"),
        (np.zeros(2), "place 7 of it"),
    ],
)
def test_a_column_that_does_not_fit_is_told(values: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ROBOMME.state.read(values, FINGER_M)


@pytest.mark.parametrize("image_px", [63, 14, 0, -2])
def test_pictures_of_a_side_that_no_video_has_are_refused(image_px: int) -> None:
    with pytest.raises(DatasetError, match=rf"--image-px {image_px}: videos need an even number of at least 16"):
        ImportOptions(sources=(), out=Path("out"), image_px=image_px)


@pytest.fixture
def robomme_file(tmp_path: Path) -> Path:
    """As RoboMME's recorder writes it: an action, and what was seen after it."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "record_dataset_VideoUnmask.h5"
    with h5py.File(path, "w") as file:
        setup = file.create_group("episode_4/setup")
        setup["seed"], setup["difficulty"], setup["task_goal"] = 6007, "hard", ["watch, then pick", "other words"]
        for step in range(12):
            at = file.create_group(f"episode_4/timestep_{step}")
            for camera in ("front_rgb", "wrist_rgb"):
                at[f"obs/{camera}"] = np.full((16, 16, 3), 10 * step, np.uint8)
            at["obs/joint_state"], at["obs/gripper_state"] = np.full(7, 1.0 * step), np.full(2, 0.04)
            at["action/joint_action"] = np.full(8, 100.0 + step)
            at["info/is_video_demo"] = step < 5
            at["info/simple_subgoal"] = "pick it" if step < 11 else "task complete"
            at["info/grounded_subgoal"] = "pick it at <3, 4>"
    return path


@pytest.mark.parametrize("column", ["obs/joint_state", "obs/gripper_state", "action/joint_action"])
def test_a_number_of_robomme_s_file_that_is_not_finite_is_told(robomme_file: Path, column: str) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(robomme_file, "r+") as file:
        file[f"episode_4/timestep_3/{column}"][0] = np.nan
    options = ImportOptions(sources=(robomme_file,), out=robomme_file.parent / "out", image_px=16, progress=False)
    with pytest.raises(DatasetError, match=rf"Unmask\.h5: episode 4: .*{column.partition('/')[2]}.* has nan in row 3"):
        import_sets(options)


def test_robomme_s_own_file(robomme_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert import_sets(ImportOptions(sources=(robomme_file,), out=out, image_px=16, progress=False)) == (1, 0)
    data = Dataset(out)
    (entry,) = data.episodes
    assert (entry.task, entry.seed, entry.difficulty) == ("VideoUnmask", 6007, "hard")
    assert (entry.instruction, entry.num_rows, entry.num_demonstration_rows) == ("watch, then pick", 11, 4)
    rows = data.rows(0)
    np.testing.assert_array_equal(rows.state[:, 0], np.arange(11))
    np.testing.assert_array_equal(rows.action[:, 0], 101 + np.arange(11))
    np.testing.assert_array_equal(np.flatnonzero(rows.is_transition), [4])
    assert set(rows.subgoal) == {"pick it"}
    brightness = data.frames(0, "front", range(11))[:, 8, 8, 0].astype(int)
    assert np.abs(brightness - 10 * np.arange(11)).max() <= 3


def test_hdf5_without_its_reader_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(DatasetError, match="pip install h5py"):
        import_sets(ImportOptions(sources=(tmp_path / "a.h5",), out=tmp_path / "out", progress=False))


def test_delta_actions_are_added_to_their_rows(folder: Path, mapping: Path, tmp_path: Path) -> None:
    mapping.write_text('action_kind = "delta"\n' + OURS)
    import_sets(ImportOptions(sources=(folder,), out=tmp_path / "out", mapping=mapping, image_px=16, progress=False))
    before, after = Dataset(folder).rows(0), Dataset(tmp_path / "out").rows(0)
    np.testing.assert_allclose(after.action[:, :7], before.state[:, :7] + before.action[:, :7])
    np.testing.assert_array_equal(after.action[:, 7], before.action[:, 7])


def test_a_column_of_numbers_is_no_subgoal(folder: Path, mapping: Path, tmp_path: Path) -> None:
    mapping.write_text(OURS.replace('subgoal = "subgoal"', 'subgoal = "action"', 1))
    options = ImportOptions(sources=(folder,), out=tmp_path / "out", mapping=mapping, image_px=16, progress=False)
    with pytest.raises(DatasetError, match=r"episode 0: column action has the type .*, expected texts"):
        import_sets(options)


def test_episodes_without_subgoals_are_counted(folder: Path, mapping: Path, tmp_path: Path) -> None:
    mapping.write_text("\n".join(line for line in OURS.splitlines() if "subgoal" not in line))
    options = ImportOptions(sources=(folder,), out=tmp_path / "out", mapping=mapping, image_px=16, progress=False)
    assert import_sets(replace(options, episodes=2)) == (2, 2)
