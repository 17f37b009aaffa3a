"""Ways around things, told with the sides on which these are seen to be passed."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ponderpounce.training.deeds import passing_side
from ponderpounce.training.places import PLACE
from ponderpounce.training.ways import seen_side, with_seen_sides

AROUND = "move to the nearest {} target by circling around the stick {}"
TURNS = ("clockwise", "counterclockwise")


def simulators_text(first: str, stretches: list[tuple[str, int, int]]) -> str:
    """As the simulator and `with_plans` tell a way of these stretches: turn, row and column of each."""
    told = [f"{turn} to <{y}, {x}>" for turn, y, x in stretches[:2]]
    told += [f"{turn} <{y}, {x}>" for turn, y, x in stretches[2:]]
    return AROUND.format(first, ", then ".join(told[:2]) + "".join(f", {each}" for each in told[2:]))


@st.composite
def ways(draw: st.DrawFn) -> tuple[str, list[tuple[str, int, int]]]:
    columns = draw(st.lists(st.integers(0, 255), min_size=1, max_size=7))
    columns = [x for n, x in enumerate(columns) if n == 0 or x != columns[n - 1]]
    stretches = [(draw(st.sampled_from(TURNS)), draw(st.integers(0, 255)), x) for x in columns]
    return draw(st.sampled_from(["left", "right"])), stretches


@given(ways())
def test_sides_are_those_of_every_stretch_told_alone(way: tuple[str, list[tuple[str, int, int]]]) -> None:
    first, stretches = way
    told = with_seen_sides(simulators_text(first, stretches))
    ends = pairwise(x for _, _, x in stretches)
    leads = [first, *("left" if after > before else "right" for before, after in ends)]
    alone = [
        passing_side(AROUND.format(lead, f"{turn} to <{y}, {x}>"))
        for lead, (turn, y, x) in zip(leads, stretches, strict=True)
    ]
    assert re.findall("backward|forward", told) == alone
    assert PLACE.findall(told) == [(str(y), str(x)) for _, y, x in stretches], "places stay as they are"
    assert re.findall(r"(?:counter)?clockwise", told) == [turn for turn, _, _ in stretches[:2]], (
        "which way round is told of this stretch and the next"
    )
    assert with_seen_sides(told) == told


def test_this_stretch_and_the_next_are_told_with_all_that_the_turn_follows_from() -> None:
    back = [(TURNS[1], 93, 85), (TURNS[0], 84, 119)]
    text = simulators_text("left", [("clockwise", 93, 85), ("clockwise", 84, 119), *back])
    assert with_seen_sides(text) == (
        "move to the nearest left target by circling around the stick backward clockwise to <93, 85>, "
        "then left backward clockwise to <84, 119>, backward <93, 85>, backward <84, 119>"
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "press the button at <60, 90>",
        "move forward to <66, 172>, then <52, 148>, left <52, 100>",
        AROUND.format("left", "clockwise"),
    ],
)
def test_other_texts_stay_as_they_are(text: str) -> None:
    assert with_seen_sides(text) == text


@pytest.mark.parametrize("lead", ["left", "right"])
@pytest.mark.parametrize("turn", TURNS)
def test_a_mirror_changes_both_words_and_not_the_side(lead: str, turn: str) -> None:
    mirrored = {"left": "right", "right": "left", TURNS[0]: TURNS[1], TURNS[1]: TURNS[0]}
    assert seen_side(mirrored[lead], mirrored[turn]) == seen_side(lead, turn)
    assert seen_side(lead, mirrored[turn]) != seen_side(lead, turn)
