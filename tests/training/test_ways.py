"""Ways around things as PONDER tells them: by number, and with the sides on which these are seen to be passed."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.ponder.context import IGNORE
from dual_system.training.deeds import course, narration, passing_side
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.places import PLACE
from dual_system.training.training_episode import TrainingEpisode
from dual_system.training.ways import by_sight, seen_side, stretch_numbers, without_numbers
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


@pytest.mark.parametrize(
    "text",
    [
        "",
        "press the button at <60, 90>",
        "move left",
        "move left to <1, 2>",
        "move forward-left to <66, 172>, then <52, 148>, left <52, 100>, back <66, 172>",
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
    way = demonstrated_way(stretches)
    texts = [*way.subgoals][::2]
    shown = replace(way, said=["", *texts, "", "press the button"])
    told = shown.with_plans().with_ways_by_sight()
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


def demonstrated_way(stretches: list[tuple[str, str, int, int]]) -> TrainingEpisode:
    """Two ticks, and two instants of a demonstration, of every stretch of a way: lead, turn, row and column."""
    texts = []
    for n, (lead, turn, y, x) in enumerate(stretches):
        then = "".join(f", then {turn} to <{y}, {x}>" for _, turn, y, x in stretches[n + 1 : n + 2])
        texts += [AROUND.format(lead, f"{turn} to <{y}, {x}>{then}")] * 2
    notes = [f"{n // 2 + 1} {course(text)}" for n, text in enumerate(texts)]
    shown = episode(len(texts), changes=range(0, len(texts), 2), num_demo=len(texts))
    return replace(shown, subgoals=texts, demo_subgoals=texts, demo_notes=notes)


@given(st.sets(st.integers(1, 5)))
def test_with_other_sides_all_words_tell_the_same_other_way(others: set[int]) -> None:
    stretches = [("left", "clockwise", 93, 85), ("left", TURNS[1], 84, 119), ("right", "clockwise", 93, 85)]
    shown = demonstrated_way([*stretches, ("right", TURNS[1], 99, 40)])
    told = shown.with_other_sides(others)
    side = re.compile(r"(?:back|for)ward")
    before, after = (narration(each.demo_subgoals) for each in (shown, told))
    pairs = zip(side.findall(before), side.findall(after), strict=True)
    assert [n for n, (one, other) in enumerate(pairs, 1) if one != other] == sorted(others & {1, 2, 3, 4})
    assert side.sub("", before) == side.sub("", after)
    numbers = stretch_numbers(told.demo_subgoals)
    seen = [f"{number} {course(text)}" for number, text in zip(numbers, told.demo_subgoals, strict=True)]
    assert [*told.demo_notes] == seen, "notes tell the stretches as the narration does"
    assert [*told.demo_subgoals] == [*told.subgoals], "and what is to be done is what was shown"
    assert told.with_other_sides(others).demo_notes == shown.demo_notes


def test_stretches_that_come_back_are_numbered_on() -> None:
    there, back = ("left", "clockwise", 93, 85), ("right", "clockwise", 90, 50)
    shown = demonstrated_way([there, back, there, back])
    assert stretch_numbers(["static", *shown.demo_subgoals, "static"]) == [0, 1, 1, 2, 2, 3, 3, 4, 4, 4]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_row_with_other_sides_is_read_from_its_notes_and_ends_soon(share: float) -> None:
    shown = demonstrated_way([("left", "clockwise", 93, 85), ("left", TURNS[1], 84, 119)] * 6)
    form = replace(FORM, takes_notes=True)
    config = ExampleConfig(clocks=EVALUATION, narrates=True, ways_by_sight=True, other_ways=share)
    made = [make_example(shown, form, config, np.random.default_rng(seed)) for seed in range(5)]
    told = {each.episode.reasoning for each in made}
    assert len(told) == (5 if share else 1)
    for each in made:
        num_learned = sum(target != IGNORE for target in each.row().targets)
        alone = replace(each, heeded_demo=None).row()
        assert (num_learned < sum(target != IGNORE for target in alone.targets)) == bool(share)
        assert each.heeded_demo == ((False,) * len(shown.demo) if share else None)
        if share:
            assert len(each.schedule.queries) <= 2
