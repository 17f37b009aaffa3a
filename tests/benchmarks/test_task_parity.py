"""The parity table's arithmetic, and that the tests' scenes are found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.contact_sheets import sheet
from benchmarks.recorded import layout_of, recorded_tasks
from benchmarks.task_parity import apart
from benchmarks.task_speed import row_of, step_row
from dual_system.tasks.task import make_task

DATA = Path(__file__).parents[1] / "tasks" / "data"


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ("press the button at <69, 99>", "press the button at <70, 97>", [1, 2]),
        ("pick up the 2nd cube at <1, 2> from <3, 4>", "pick up the 2nd cube at <1, 2> from <3, 9>", [0, 0, 0, 5]),
        ("static", "static", []),
        ("pick up 3 cubes", "pick up 7 cubes", []),
    ],
)
def test_only_coordinates_are_compared(ours: str, theirs: str, expected: list[int]) -> None:
    assert apart(ours, theirs) == expected


@pytest.mark.parametrize("task", ["PickHighlight", "StopCube", "VideoUnmaskSwap", "VideoRepick", "RouteStick"])
def test_the_tests_scene_is_found_and_is_the_task_s(task: str) -> None:
    layout = layout_of(task)
    sampled = make_task(task).sample(np.random.default_rng(0), "medium")
    assert type(layout) is type(sampled)
    assert make_task(task).instruction(layout)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="give --recordings the folder"):
        recorded_tasks(tmp_path)


def test_a_sheet_shows_every_frame_in_its_place() -> None:
    frames = [[np.full((2, 2, 3), 10 * y + x, dtype=np.uint8) for x in range(3)] for y in range(2)]
    picture = sheet(frames)
    assert picture.shape == (8, 14, 3)
    assert [[int(picture[y * 6, x * 6, 0]) for x in range(3)] for y in range(2)] == [[0, 1, 2], [10, 11, 12]]
    assert (picture[2:6] == 255).all()


def test_speeds_are_sums_over_sums() -> None:
    episode = {"simulated_s": 10.0, "wall_s": 1.0, "cpu_s": 0.5, "success": True}
    row = row_of("ours", [episode, episode | {"wall_s": 4.0}])
    assert (row["simulated_s_per_wall_s"], row["simulated_s_per_cpu_s"], row["slowest_episode"]) == (4.0, 20.0, 2.5)
    assert row["episodes_per_hour"] == 1440
    peer = step_row("theirs", [episode], ("simulated_s", "wall_s", "cpu_s"), None)
    assert (peer["wall_ms_per_step"], peer["robosuite_takes_times_wall"]) == (5.0, None)
    ours = step_row("ours", [episode | {"wall_s": 0.5}], ("simulated_s", "wall_s", "cpu_s"), peer)
    assert (ours["robosuite_takes_times_wall"], ours["robosuite_takes_times_cpu"]) == (2.0, 1.0)
