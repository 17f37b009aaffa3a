"""Windows: each pixel is the mean of the camera's pixels that it covers, for cameras of any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.windows import WHOLE, Windows, placed_in, seen_through, through

FRONT = (10 / 128, 28 / 128, 82 / 128, 100 / 128)


def picture(side: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (side, side, 3), dtype=np.uint8)


def test_the_whole_window_at_its_own_size_is_the_picture() -> None:
    view = picture(64)
    assert np.array_equal(seen_through(WHOLE, view, (64, 64)), view)


def test_whole_pixels_are_cut_out_unchanged() -> None:
    view = picture(128)
    assert np.array_equal(seen_through(FRONT, view, (72, 72)), view[10:82, 28:100])


def test_a_pixel_is_the_mean_of_the_four_that_it_covers() -> None:
    view = picture(256)
    cut = view[20:164, 56:200].astype(np.float64)
    mean = cut.reshape(72, 2, 72, 2, 3).mean(axis=(1, 3))
    assert np.array_equal(seen_through(FRONT, view, (72, 72)), np.rint(mean).astype(np.uint8))


@settings(max_examples=25, deadline=None)
@given(side=st.sampled_from([114, 128, 200, 256, 480]), shade=st.integers(0, 255))
def test_one_colour_stays_that_colour(side: int, shade: int) -> None:
    view = np.full((side, side, 3), shade, np.uint8)
    assert np.all(seen_through(FRONT, view, (64, 64)) == shade)


@settings(max_examples=25, deadline=None)
@given(row=st.integers(24, 140), column=st.integers(60, 190))
def test_a_bright_spot_lies_where_its_place_says(row: int, column: int) -> None:
    view = np.zeros((256, 256, 3), np.uint8)
    view[row - 4 : row + 4, column - 4 : column + 4] = 255
    seen = seen_through(FRONT, view, (64, 64))[..., 0].astype(np.float64)
    middle = [(seen.sum(axis) @ (np.arange(64) + 0.5)) / seen.sum() / 64 for axis in (1, 0)]
    assert middle == pytest.approx(placed_in(FRONT, (row / 256, column / 256)), abs=2e-3)


def test_no_window_is_enlarged() -> None:
    with pytest.raises(ValueError, match="113 x 113 px came; this window needs at least 114 x 114 px"):
        seen_through(FRONT, picture(113), (64, 64))


def test_a_camera_that_is_too_small_is_named_with_the_least_size() -> None:
    windows = Windows((FRONT, WHOLE))
    assert windows.unreadable([(256, 256), (64, 64)], (64, 64)) is None
    assert windows.unreadable([(100, 256), (64, 64)], (64, 64)) == (0, "pictures of at least 114 x 114 px")
    assert windows.unreadable([(256, 256), (63, 64)], (64, 64)) == (1, "pictures of at least 64 x 64 px")
    assert windows.unreadable([(256, 256)] * 3, (64, 64)) == (2, "2 cameras")
    (least,) = windows.readable_sizes((64, 64))
    assert windows.unreadable([least, least], (64, 64)) is None


def test_a_missing_camera_stays_missing_and_no_windows_change_nothing() -> None:
    view = picture(128)
    first, second = through((FRONT, WHOLE), [None, view], (64, 64))
    assert first is None
    assert second is not None
    assert second.shape == (64, 64, 3)
    assert through((), [view, None], (64, 64))[0] is view
    with pytest.raises(ValueError, match="windows for 1 cameras"):
        through((WHOLE,), [view, view], (64, 64))


@pytest.mark.parametrize("box", [(0.5, 0.0, 0.5, 1.0), (0.0, 0.0, 1.1, 1.0), (0.2, 0.5, 0.6, 0.4)])
def test_a_box_that_is_none_is_refused(box: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="expected 0 <= top < bottom"):
        Windows((box,))
