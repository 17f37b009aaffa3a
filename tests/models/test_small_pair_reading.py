"""One crop of any camera that holds it at a whole multiple is the same picture; every other size is refused.

The tokens of the robot's state are bins of two numbers, and tell nothing else of it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.arm import tool_poses
from dual_system.models.ponder.observation import Size, check_cameras
from dual_system.models.small_pair.reading import MAX_FINGER_M, MAX_HEIGHT_M, MAX_SHRINK, CropReader

WHOLE = CropReader(camera=0, box=(0, 0, 1, 1), first_state_id=456, num_finger_bins=16, num_height_bins=32)
WORKSPACE = replace(WHOLE, box=(0.375, 0.25, 0.875, 0.75))  # 64 x 64 of 128 px
HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4])


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def enlarged(picture: np.ndarray, times: int) -> np.ndarray:
    return picture.repeat(times, axis=0).repeat(times, axis=1)


# -- pictures


@given(times=st.integers(1, 6), top=st.integers(0, 8), left=st.integers(0, 8), seed=st.integers(0, 99))
def test_a_crop_of_an_enlarged_picture_is_the_crop_of_the_picture(times: int, top: int, left: int, seed: int) -> None:
    picture = noise(16, 16, seed)
    reader = replace(WHOLE, box=(top / 16, left / 16, (top + 8) / 16, (left + 8) / 16))
    expected = picture[top : top + 8, left : left + 8]
    assert np.array_equal(reader.images([enlarged(picture, times)], (8, 8)), expected[None])


@given(times=st.integers(2, MAX_SHRINK), seed=st.integers(0, 99))
def test_a_mean_is_exact_and_rounds_half_up(times: int, seed: int) -> None:
    picture = noise(4 * times, 4 * times, seed)
    squares = picture.reshape(4, times, 4, times, 3).astype(np.float64)
    expected = np.floor(squares.mean(axis=(1, 3)) + 0.5)  # doubles hold these means well enough to tell a half
    assert np.array_equal(WHOLE.images([picture], (4, 4))[0], expected)


def test_the_brightest_picture_at_the_greatest_shrink_stays_white() -> None:
    white = np.full((4 * MAX_SHRINK, 4 * MAX_SHRINK, 3), 255, np.uint8)
    assert (WHOLE.images([white], (4, 4)) == 255).all()


edges = st.lists(st.integers(0, 20), min_size=2, max_size=2, unique=True).map(sorted)


def exact_sizes(box_20: tuple[int, int, int, int], px: Size) -> list[Size]:
    """Camera sizes of which a box of twentieths is some whole multiple of ``px``, by exact fractions."""
    top, left, bottom, right = box_20
    sizes = []
    for shrink in range(1, MAX_SHRINK + 1):
        height, width = Fraction(20 * shrink * px[0], bottom - top), Fraction(20 * shrink * px[1], right - left)
        if all(each.denominator == 1 for each in (height, width, height * top / 20, width * left / 20)):
            sizes.append((int(height), int(width)))
    return sizes


@given(
    rows=edges,
    columns=edges,
    camera=st.integers(0, 1),
    px=st.sampled_from([(4, 4), (4, 8), (6, 3)]),
    size=st.tuples(st.integers(1, 80), st.integers(1, 80)),
)
def test_a_size_is_read_exactly_if_it_is_named(
    rows: list[int], columns: list[int], camera: int, px: Size, size: Size
) -> None:
    (top, bottom), (left, right) = rows, columns
    reader = replace(WHOLE, camera=camera, box=(top / 20, left / 20, bottom / 20, right / 20))
    sizes = exact_sizes((top, left, bottom, right), px)
    if not sizes:
        with pytest.raises(ValueError, match="no camera size suits the box"):
            reader.readable_sizes(px)
        return
    assert reader.readable_sizes(px) == sizes
    for good in sizes[:2]:
        assert reader.images([noise(*good)] * 2, px).shape == (1, *px, 3)
        assert reader.unreadable([good] * 2, px) is None
    assert (reader.unreadable([size] * 2, px) is None) == (size in sizes)
    if size not in sizes:
        with pytest.raises(ValueError, match=f"camera {camera} gives {size[0]} x {size[1]} px pictures"):
            reader.images([noise(*size)] * 2, px)


def test_half_of_a_picture_needs_one_twice_as_wide() -> None:
    assert replace(WHOLE, box=(0, 0, 1, 0.5)).readable_sizes((64, 64))[:2] == [(64, 128), (128, 256)]


@pytest.mark.parametrize("camera", [0, 1])
def test_the_camera_that_is_read_is_the_one_that_was_declared(camera: int) -> None:
    views = [noise(128, 128, seed) for seed in range(2)]
    (image,) = replace(WORKSPACE, camera=camera).images(views, (64, 64))
    assert np.array_equal(image, views[camera][48:112, 32:96])


@pytest.mark.parametrize(
    ("sizes", "camera", "said"),
    [
        ([(200, 200)], 0, "camera 0 gives 200 x 200 px pictures; PONDER reads 128 x 128 or 256 x 256 or .* and so on"),
        ([(128, 128), (96, 96)], 1, "camera 1 gives 96 x 96 px"),
        ([(128, 128)], 1, "camera 1 gives none; PONDER reads 128 x 128 or"),
    ],
)
def test_cameras_that_cannot_be_read_are_refused_with_sizes_that_can(sizes: list[Size], camera: int, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check_cameras(sizes, replace(WORKSPACE, camera=camera), (64, 64))


def test_a_camera_that_is_not_read_may_have_any_size() -> None:
    check_cameras([(128, 128), (17, 5)], WORKSPACE, (64, 64))


def test_a_box_that_no_camera_suits_is_refused() -> None:
    with pytest.raises(ValueError, match="no camera size suits the box"):
        replace(WHOLE, box=(0, 0, 1, 1 / 3 + 1e-3)).readable_sizes((64, 64))


def test_a_view_that_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match="1 views came; PONDER reads camera 1, counted from 0"):
        replace(WHOLE, camera=1).images([noise(64, 64)], (64, 64))


def test_a_view_that_is_no_picture_is_named() -> None:
    with pytest.raises(ValueError, match=re.escape("frame 1: float32 of shape (64, 64, 3); expected uint8 (height")):
        WHOLE.images([noise(64, 64), np.zeros((64, 64, 3), np.float32)], (64, 64))


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": -1},
        {"box": (0.5, 0, 0.5, 1)},
        {"box": (0, 0, 1, 1.1)},
        {"num_finger_bins": 0},
        {"num_height_bins": 0},
        {"first_state_id": -1},
    ],
    ids=str,
)
def test_a_reader_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"expected a camera|bins are at least 1"):
        replace(WHOLE, **wrong)


# -- tokens of the state

joints = st.lists(st.floats(-0.6, 0.6), min_size=7, max_size=7).map(lambda moves: HOME + np.array(moves))
fingers = st.floats(-0.01, 0.06)


@given(joints, fingers)
def test_the_tokens_are_the_bins_of_finger_and_height(joints_rad: np.ndarray, finger_m: float) -> None:
    finger, height = WHOLE.state_ids([*joints_rad, finger_m])
    height_m = tool_poses(joints_rad).position_m[2]
    assert {finger, height} <= set(WHOLE.state_rows)
    for token, first, share, num_bins in (
        (finger, 456, finger_m / MAX_FINGER_M, 16),
        (height, 456 + 16, height_m / MAX_HEIGHT_M, 32),
    ):
        number = token - first
        assert 0 <= number < num_bins
        assert number <= share * num_bins or number == 0
        assert share * num_bins < number + 1 or number == num_bins - 1


@given(joints, fingers, st.floats(-1.5, 1.5))
def test_the_tokens_do_not_tell_where_above_the_table_or_on_which_side(
    joints_rad: np.ndarray, finger_m: float, turn_rad: float
) -> None:
    turned = joints_rad + turn_rad * np.eye(7)[0]
    mirrored = joints_rad * np.array([-1, 1, -1, 1, -1, 1, -1])
    heights_m = [tool_poses(each).position_m[2] * 100 for each in (joints_rad, turned, mirrored)]
    if len({round(height, 6) // 1 for height in heights_m}) == 1:  # on the edge between two bins rounding decides
        assert len({WHOLE.state_ids([*each, finger_m]) for each in (joints_rad, turned, mirrored)}) == 1


@pytest.mark.parametrize("state", [np.zeros(7), np.zeros((1, 8)), np.full(8, np.nan), [*HOME, np.inf]])
def test_what_is_no_state_is_refused(state: np.ndarray) -> None:
    with pytest.raises(ValueError, match="8 finite numbers"):
        WHOLE.state_ids(state)


def test_a_state_that_did_not_come_is_refused() -> None:
    with pytest.raises(ValueError, match="reads the robot's state with every observation; none came"):
        WHOLE.state_ids(None)
