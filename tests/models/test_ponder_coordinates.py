"""Grounded coordinates: to 0..1000 and back without loss."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.coordinates import (
    PLACE_WORDS,
    moved_places,
    normalised_text,
    without_places,
    xy_1000_from_yx_px,
    yx_px_from_xy_1000,
)

sizes = st.integers(1, 1000)


@given(st.data(), sizes, sizes)
def test_pixels_survive_the_round_trip(data: st.DataObject, height: int, width: int) -> None:
    yx_px = (data.draw(st.integers(0, height)), data.draw(st.integers(0, width)))
    xy_1000 = xy_1000_from_yx_px(yx_px, (height, width))
    assert all(0 <= value <= 1000 for value in xy_1000)
    assert yx_px_from_xy_1000(xy_1000, (height, width)) == yx_px


def test_axes_are_swapped_and_scaled() -> None:
    assert xy_1000_from_yx_px((0, 256)) == (1000, 0)
    assert xy_1000_from_yx_px((77, 103)) == (402, 301)


def test_text_is_rewritten_everywhere() -> None:
    text = "target_0 at <77, 103> → target_1 at <71, 74>"
    assert normalised_text(text) == "target_0 at [402, 301] → target_1 at [289, 277]"


@pytest.mark.parametrize("yx_px", [(-1, 0), (0, 257)])
def test_a_pixel_outside_the_image_is_refused(yx_px: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="outside the 256 x 256 px image"):
        xy_1000_from_yx_px(yx_px)


def test_a_coordinate_beyond_1000_is_refused() -> None:
    with pytest.raises(ValueError, match=r"outside 0\.\.1000"):
        yx_px_from_xy_1000((1001, 0))


def test_the_plain_reading_has_no_place() -> None:
    assert without_places("pick up the cube at [438, 512], which is red") == "pick up the cube, which is red"
    assert without_places("Hook the cube at [1, 2] to the target at [3, 4]") == "Hook the cube to the target"


@given(y=st.integers(0, 256), x=st.integers(0, 256), move=st.tuples(st.integers(-300, 300), st.integers(-300, 300)))
def test_a_moved_place_is_moved_by_pixels_and_stays_in_the_picture(y: int, x: int, move: tuple[int, int]) -> None:
    moved = moved_places(normalised_text(f"press <{y}, {x}>"), move)
    there = min(max(y + move[1], 0), 256), min(max(x + move[0], 0), 256)
    assert moved == normalised_text("press <{}, {}>".format(*there))


@given(y=st.integers(0, 256), x=st.integers(0, 256))
def test_both_halves_of_every_place_are_words(y: int, x: int) -> None:
    first, second = normalised_text(f"at <{y}, {x}>").removeprefix("at").split(",")
    assert {f"{first},", second} <= set(PLACE_WORDS)
