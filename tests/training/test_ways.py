"""Ways as PONDER tells them: by number, and around things with the sides on which these are seen to be passed."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from ponderpounce.training.deeds import narration, passing_side
from ponderpounce.training.example import ExampleConfig, make_example
from ponderpounce.training.places import PLACE
from ponderpounce.training.ways import by_sight, seen_side, without_numbers
from tests.training.test_example import FORM, episode

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


@given(ways(), st.integers(1, 9))
def test_sides_are_those_of_every_stretch_told_alone(way: tuple[str, list[tuple[str, int, int]]], number: int) -> None:
    first, stretches = way
    told = by_sight(simulators_text(first, stretches), number)
    ends = pairwise(x for _, _, x in stretches)
    leads = [first, *("left" if after > before else "right" for before, after in ends)]
    alone = [
        passing_side(AROUND.format(lead, f"{turn} to <{y}, {x}>"))
        for lead, (turn, y, x) in zip(leads, stretches, strict=True)
    ]
    found = re.findall(r"(\d+) (left|right) (backward|forward)", told)
    assert found == [(str(number + n), *each) for n, each in enumerate(zip(leads, alone, strict=True))]
    assert PLACE.findall(told) == [(str(y), str(x)) for _, y, x in stretches], "places stay as they are"
    assert re.findall(r"(?:counter)?clockwise", told) == [turn for turn, _, _ in stretches[:2]], (
        "which way round is told of this stretch and the next"
    )
    assert by_sight(told, number) == told


def test_this_stretch_and_the_next_are_told_with_all_that_the_turn_follows_from() -> None:
    back = [(TURNS[1], 93, 85), (TURNS[0], 84, 119)]
    text = simulators_text("left", [("clockwise", 93, 85), ("clockwise", 84, 119), *back])
    assert by_sight(text, 2) == (
        "move to the nearest left target by circling around the stick 2 left backward clockwise to <93, 85>, "
        "then 3 left backward clockwise to <84, 119>, 4 right backward <93, 85>, 5 left backward <84, 119>"
    )


def test_a_way_around_nothing_is_told_by_numbers_alone() -> None:
    text = "move forward-left to <66, 172>, then <52, 148>, left <52, 100>, back <66, 172>"
    assert by_sight(text, 3) == "move 3 forward-left to <66, 172>, then 4 <52, 148>, 5 left <52, 100>, 6 back <66, 172>"
    assert by_sight("move left to <1, 2>", 1) == "move 1 left to <1, 2>"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "press the button at <60, 90>",
        "move left",
        "move to the top of the left-side target at <9, 9> for the first time",
        "Hook the cube at <82, 97> to the target at <112, 140> with the peg",
        AROUND.format("left", "clockwise"),
    ],
)
def test_other_texts_stay_as_they_are(text: str) -> None:
    assert by_sight(text, 2) == text


@pytest.mark.parametrize("lead", ["left", "right"])
@pytest.mark.parametrize("turn", TURNS)
def test_a_mirror_changes_both_words_and_not_the_side(lead: str, turn: str) -> None:
    mirrored = {"left": "right", "right": "left", TURNS[0]: TURNS[1], TURNS[1]: TURNS[0]}
    assert seen_side(mirrored[lead], mirrored[turn]) == seen_side(lead, turn)
    assert seen_side(lead, mirrored[turn]) != seen_side(lead, turn)


def test_plans_of_an_episode_tell_each_stretch_as_its_narration_does() -> None:
    """By number and side: what stands there is copied from one to the next, and looked up."""
    stretches = [("left", "clockwise", 93, 85), ("left", TURNS[1], 84, 119), ("right", "clockwise", 93, 85)]
    texts = []
    for n, (lead, turn, y, x) in enumerate(stretches):
        then = "".join(f", then {turn} to <{y}, {x}>" for _, turn, y, x in stretches[n + 1 : n + 2])
        texts.append(AROUND.format(lead, f"{turn} to <{y}, {x}>{then}"))
    ticks = [text for text in texts for _ in range(2)]
    shown = replace(episode(6, changes=(0, 2, 4)), subgoals=ticks, said=["", *texts, "", "press the button"])
    told = replace(shown, demo=((shown.frames[0]),) * 3).with_plans().with_ways_by_sight()
    expected = narration(texts).split(", ")
    stretch = re.compile(r"(\d \w+ (?:back|for)ward)(?: (?:counter)?clockwise to)?( <\d+, \d+>)")
    for n in range(3):
        found = ["".join(each) for each in stretch.findall(told.words[2 * n])]
        assert found == re.findall(r"\d \w+ \w+ <\d+, \d+>", ", ".join(expected))[n:]
    assert stretch.findall(told.said[3])[0][0].startswith("2 "), "what was said is told as if it was of then"
    assert told.said[-1] == "press the button"


@pytest.mark.parametrize(
    ("told", "plain"),
    [
        ("2 right forward <89, 16>, 3 left backward <9, 2>", "forward <89, 16>, backward <9, 2>"),
        ("2 right forward", "forward"),
        ("1 forward-left <8, 9>, 2 left <8, 1>", "forward-left <8, 9>, left <8, 1>"),
        ("second <20, 30>", "second <20, 30>"),
        ("<20, 30> to <9, 8>", "<20, 30> to <9, 8>"),
        ("press it, <110, 77>, 80, 137", "press it, <110, 77>, 80, 137"),
    ],
)
def test_without_numbers_sides_and_places_are_left(told: str, plain: str) -> None:
    assert without_numbers(told) == plain


@pytest.mark.parametrize("asked", [False, True])
def test_ways_have_numbers_where_a_recipe_asks_for_them_and_nowhere_else(asked: bool) -> None:
    text = AROUND.format("left", "clockwise to <9, 60>")
    shown = replace(
        episode(6, num_demo=2), subgoals=[text] * 6, demo_subgoals=[text] * 2, demo_notes=["1 left backward", ""]
    )
    config = ExampleConfig(clocks=EVALUATION, narrates=True, ways_by_sight=asked)
    told = make_example(shown, FORM, config, np.random.default_rng(0)).episode
    seen = "1 left backward" if asked else "backward"
    assert [*told.demo_notes, told.reasoning] == [seen, "", f"{seen} <9, 60>"]
    assert told.words[0] == (by_sight(text, 1) if asked else text)
