"""Stand-ins: alike for alike subgoals, told apart otherwise, and of cognition's own scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ponderpounce.training.stand_in import NUM_PLACE_FEATURES, stand_in

PIXELS = st.integers(0, 255)
PICK = "pick up the {nth} highlighted cube at <{y}, {x}>, which is {colour}"


@given(y=PIXELS, x=PIXELS, size=st.sampled_from([64, 128, 96]))
def test_its_rms_is_about_one(y: int, x: int, size: int) -> None:
    values = stand_in(PICK.format(nth="first", y=y, x=x, colour="red"), size)
    assert values.shape == (size,)
    assert 0.7 < float(np.sqrt(np.mean(values**2))) < 1.3


@given(y=PIXELS, x=PIXELS)
def test_colour_is_for_the_reader_not_for_the_hand(y: int, x: int) -> None:
    red, blue = (stand_in(PICK.format(nth="first", y=y, x=x, colour=colour), 128) for colour in ("red", "blue"))
    np.testing.assert_array_equal(red, blue)


@given(a=st.tuples(PIXELS, PIXELS), b=st.tuples(PIXELS, PIXELS))
def test_nearer_places_look_more_alike_and_texts_do_not_move(a: tuple[int, int], b: tuple[int, int]) -> None:
    here, there = (stand_in(PICK.format(nth="first", y=y, x=x, colour="red"), 128) for y, x in (a, b))
    np.testing.assert_array_equal(here[NUM_PLACE_FEATURES:], there[NUM_PLACE_FEATURES:])
    assert np.array_equal(here, there) == (a == b)


def test_other_texts_are_nearly_orthogonal() -> None:
    texts = (
        "press the button at <60, 80>",
        "place the cube onto the table",
        PICK.format(nth="first", y=1, x=2, colour=""),
    )
    codes = np.stack([stand_in(text, 512)[NUM_PLACE_FEATURES:] for text in texts])
    cosines = np.corrcoef(codes)
    assert np.abs(cosines - np.eye(3)).max() < 0.2


def test_a_text_without_a_place_points_at_the_middle() -> None:
    nowhere, middle = (stand_in(f"place the cube{at}", 64) for at in ("", " at <128, 128>"))
    np.testing.assert_array_equal(nowhere[:NUM_PLACE_FEATURES], middle[:NUM_PLACE_FEATURES])


def test_too_small_a_carrier_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 52"):
        stand_in("press", 40)
