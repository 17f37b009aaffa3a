"""Stand-ins: alike for alike subgoals, told apart otherwise, and of cognition's own scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features, wave_columns
from dual_system.training.stand_in import MOST_NUMBERS, number_weights, skill_of, stand_in, text_code

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


@given(y=PIXELS, x=PIXELS, size=st.integers(MOST_NUMBERS, 300))
def test_a_larger_one_tells_the_same_where_it_did_and_asks_for_no_more(y: int, x: int, size: int) -> None:
    text = PICK.format(nth="first", y=y, x=x, colour="red")
    known, larger = stand_in(text, MOST_NUMBERS), stand_in(text, size)
    np.testing.assert_array_equal(larger[:MOST_NUMBERS], known)
    assert not larger[MOST_NUMBERS:].any()
    errors = np.random.default_rng(size).normal(size=size)
    for evenly in (False, True):
        meant = (errors[:MOST_NUMBERS] * number_weights(MOST_NUMBERS, evenly=evenly)).mean()
        assert (errors * number_weights(size, evenly=evenly)).mean() == pytest.approx(meant, rel=1e-5)


def test_other_texts_are_nearly_orthogonal() -> None:
    texts = (
        "press the button at <60, 80>",
        "place the cube onto the table",
        PICK.format(nth="first", y=1, x=2, colour=""),
    )
    codes = np.stack([text_code(skill_of(text), 512) for text in texts])
    cosines = np.corrcoef(codes)
    assert np.abs(cosines - np.eye(3)).max() < 0.2


def test_a_text_without_a_place_points_at_the_middle() -> None:
    nowhere, middle = (stand_in(f"place the cube{at}", 64) for at in ("", " at <128, 128>"))
    np.testing.assert_array_equal(nowhere[:NUM_PLACE_FEATURES], middle[:NUM_PLACE_FEATURES])


@pytest.mark.parametrize(
    ("subgoal", "skill"),
    [
        (PICK.format(nth="second", y=1, x=2, colour="red"), "pick up the second highlighted cube at <>"),
        ("pick up the highlighted cube at <1, 2>, which is green", "pick up the highlighted cube at <>"),
        ("pick up the highlighted cube, which is green", "pick up the highlighted cube"),
        ("place the cube onto the table", "place the cube onto the table"),
        ("put the blue cube on the table", "place the cube onto the table"),
        ("press the second button at <64, 103>", "press the button at <>"),
        ("press the button at <64, 103> to stop", "press the button at <>"),
        ("press the button to stop", "press the button"),
        ("pick up the third blue cube at <76, 176>", "pick up the first highlighted cube at <>, then drop it"),
        ("pick up the red cube for the second time", "pick up the first highlighted cube, then place it"),
        ("pick up the cube at <99, 126>", "pick up the first highlighted cube at <>, then place it"),
        ("pick up the blue cube at <99, 126>", "pick up the first highlighted cube at <>, then swing it"),
        ("pick up the correct cube at <3, 4> for the third time", "pick up the first highlighted cube at <>"),
        ("put it down", "place the cube onto the table"),
        ("place the cube onto the correct target at <7, 8>", "place the cube onto the target at <>"),
        ("pick up the container at <85, 165> that hides the red cube", "pick up the container at <>"),
        ("put down the container", "put down the container"),
        ("place the green cube onto the target at <101, 127>", "place the cube onto the target at <>"),
        ("move to the top of the left-side target at <8, 7> for the first time", "move to the top of the target at <>"),
        ("put it into the bin at <102, 174>", "put it into the bin at <>"),
        ("press the button to stop the cube on the target at <8, 7>", "press down"),
        ("press the button to stop the cube on the target", "press down"),
        ("move forward-left to <8, 7>, then <5, 6>", "point the stick to <>, then <>"),
        ("move right to <8, 7>", "point the stick to <>"),
        ("Pick up the cube at <99, 126>", "pick up the first highlighted cube at <>, then place it"),
    ],
)
def test_one_skill_has_one_name_in_all_tasks(subgoal: str, skill: str) -> None:
    assert skill_of(subgoal) == skill
    assert skill_of(skill) == skill


SWING = "move to the top of the {side}-side target at <8, 7> for the {nth} time"
ONE_SWING = "move it to the top of the right-side target, then put it down on the left-side target, finally press"
TWO_SWINGS = "left-side target, repeating this back-and-forth motion two times, finally press the button to stop"


@pytest.mark.parametrize(
    ("instruction", "last"),
    [(ONE_SWING, ("left", "first")), (TWO_SWINGS, ("left", "second")), ("", None)],
)
def test_the_swing_after_which_the_cube_is_put_down_is_another_skill(
    instruction: str, last: tuple[str, str] | None
) -> None:
    for side in ("left", "right"):
        for nth in ("first", "second"):
            skill = skill_of(SWING.format(side=side, nth=nth), instruction)
            then = ", then put it down" if (side, nth) == last else ""
            assert skill == f"move to the top of the target at <>{then}"


def test_what_goes_on_in_another_way_is_told_by_a_like_code() -> None:
    first = "pick up the first highlighted cube at <9, 9>"
    told = (first, "pick up the cube at <9, 9>", "pick up the red cube at <9, 9>")
    codes = np.stack([text_code(skill_of(text), 1024) for text in told])
    likeness = codes @ codes.T / codes.shape[1]
    np.testing.assert_allclose(likeness, [[1, 0.8, 0.8], [0.8, 1, 0.64], [0.8, 0.64, 1]], atol=0.12)


@given(first=st.tuples(PIXELS, PIXELS), second=st.tuples(PIXELS, PIXELS), third=st.tuples(PIXELS, PIXELS))
def test_a_second_place_lies_within_the_code(
    first: tuple[int, int], second: tuple[int, int], third: tuple[int, int]
) -> None:
    """The first is where it is without, and the second can be read off by one linear map, whatever the first is."""
    push = "push the cube at <{}, {}> to the target at <{}, {}>"
    here, there, once = (
        stand_in(text, 128)
        for text in (
            push.format(*first, *second),
            push.format(*first, *third),
            f"push the cube at <{first[0]}, {first[1]}>",
        )
    )
    np.testing.assert_array_equal(here[:NUM_PLACE_FEATURES], once[:NUM_PLACE_FEATURES])
    moved = there[NUM_PLACE_FEATURES:] - here[NUM_PLACE_FEATURES:]
    origin = stand_in(push.format(0, 0, *second), 128) - stand_in(push.format(0, 0, *third), 128)
    np.testing.assert_allclose(-moved, origin[NUM_PLACE_FEATURES:], atol=1e-5)
    assert np.array_equal(here, there) == (second == third)


def test_too_small_a_carrier_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 52"):
        stand_in("press", 40)


@pytest.mark.parametrize(("period_px", "weight"), [(16, 1), (32, 1), (64, 1), (128, 4), (256, 16)])
def test_evenly_weighed_waves_that_turn_slowly_say_as_much_of_a_small_step(period_px: int, weight: float) -> None:
    weights = number_weights(40, evenly=True)
    columns, known = wave_columns(period_px), wave_columns(64)
    assert weights[columns] == pytest.approx(weight, rel=1e-6)
    steps = np.array([place_features((y + 1, x)) - place_features((y, x)) for y in range(0, 256, 5) for x in (0, 99)])
    if period_px >= 64:
        said, expected = ((steps**2 * weights[: steps.shape[1]])[:, each].sum(1).mean() for each in (columns, known))
        assert said == pytest.approx(expected, rel=0.01)


def test_nothing_counts_more_than_64_times_and_what_tells_no_place_once() -> None:
    weights = number_weights(40, evenly=True)
    assert weights.max() == 64
    assert weights[wave_columns(512)].tolist() == [64] * 4
    assert set(weights[NUM_PLACE_FEATURES:]) == {1}
    assert weights[NUM_PLACE_FEATURES - 2 : NUM_PLACE_FEATURES].tolist() == [64, 64]  # the coordinates themselves
