"""Pegs in words: how it was done is told once, turned round as a whole, and mirrored with the picture."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.place_code import NUM_PLACE_FEATURES
from dual_system.tasks.environment import make_environment
from dual_system.training.augment import Augmentation, draw_view
from dual_system.training.deeds import deeds, narration, told_deeds
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.insertions import ends, inserted_otherwise, manner, shows_an_insertion
from dual_system.training.notes import demo_notes, laid_out_places
from dual_system.training.places import PLACE
from dual_system.training.stand_in import skill_of, stand_in
from dual_system.training.training_episode import TrainingEpisode
from tests.training.test_augment import FORM
from tests.training.test_blind import NOTING, TOLD, blind
from tests.training.test_example import episode

AT = {"far": "<91, 134>, <83, 127>", "near": "<83, 127>, <91, 134>"}  # the held end first
PICK = "Pick up the peg by grasping the {end} end at {at}"
PUT = "Insert the peg from the {side} side of the box at <111, 135>, <115, 165>"
ENDS, SIDES = ("far", "near"), ("left", "right")
OTHERS = st.sets(st.sampled_from([1, 2]))


def shown(end: str = "far", side: str = "right") -> list[str]:
    """Once a second."""
    return [PICK.format(end=end, at=AT[end])] * 5 + [PUT.format(side=side)] * 6


def asked(end: str = "far", side: str = "right") -> list[str]:
    return [
        f"{PICK.format(end=end, at=AT[end])}, {side} side",
        f"Insert the peg from the {side} side at <111, 135>, <115, 165>, {end} end",
    ]


@given(st.sampled_from(ENDS), st.sampled_from(SIDES))
def test_every_text_of_a_peg_tells_its_manner_and_no_other_does(end: str, side: str) -> None:
    for texts in (shown(end, side), asked(end, side)):
        assert [manner(text) for text in dict.fromkeys(texts)] == [f"{end} end", f"{side} side"]
    others = ["Pick up the peg at <1, 2>", "move to the top of the left-side target at <1, 2> for the first time", ""]
    assert not shows_an_insertion(others)
    assert shows_an_insertion([*others, *shown(end, side)])


@given(st.sampled_from(ENDS), st.sampled_from(SIDES), OTHERS)
def test_told_otherwise_twice_is_told_as_it_was(end: str, side: str, others: Collection[int]) -> None:
    other_end = ENDS[1 - ENDS.index(end)] if 1 in others else end
    other_side = SIDES[1 - SIDES.index(side)] if 2 in others else side
    for texts, wanted in ((shown, shown(other_end, other_side)), (asked, asked(other_end, other_side))):
        told = [inserted_otherwise(text, others) for text in texts(end, side)]
        assert told == wanted
        assert [inserted_otherwise(text, others) for text in told] == texts(end, side)


def test_a_deed_with_a_peg_has_its_other_place_beside_its_own() -> None:
    grasp, *_, put = deeds(shown("near"))
    assert (grasp.place, grasp.place_before) == ((83, 127), (91, 134))
    assert (put.place, put.place_before) == ((111, 135), (115, 165))


def test_the_narration_tells_end_and_side_with_their_places() -> None:
    assert narration(shown()) == "far end <91, 134>, <83, 127>, right side <111, 135>"
    grasp, put = told_deeds(shown())
    assert (grasp.first, grasp.last, put.first, put.last) == (0, 4, 5, 10)


@given(st.sampled_from(ENDS))
def test_places_are_noted_at_first_and_at_the_grasp_the_end_when_it_is_lifted_and_the_side_when_it_is_in(
    end: str,
) -> None:
    tools = [f"<{y}, 134>" for y in (10, 60, 88, 60, 60)] + [f"<{y}, 100>" for y in (60, 111, 80, 90, 100, 100)]
    lie = "<60, 50>, <67, 55>, <83, 127>, <91, 134>"
    notes = demo_notes(shown(end), tools, [""] * 11, laid_out=lie)
    assert {n: note for n, note in enumerate(notes) if note} == {
        0: lie,
        2: "<83, 127>, <91, 134>",  # as they were noted before, whichever is held
        4: f"{end} end {AT[end]}",
        10: "right side <111, 135>",
    }


def test_what_lies_there_is_noted_as_the_demonstration_tells_it() -> None:
    task, seed = "InsertPeg", 799100
    with make_environment(task, render=False) as environment:
        environment.reset(seed, "easy")
        told = next(iter(environment.demonstration(1))).grounded_subgoal
    lie = laid_out_places(task, seed, "easy")
    places = PLACE.findall(lie)
    assert len(places) == 6
    assert ends(told) in lie
    assert all(near[0] < far[0] for near, far in zip(places[::2], places[1::2], strict=True))
    assert places[::2] == sorted(places[::2], key=lambda place: int(place[0]))
    assert not laid_out_places("PickHighlight", seed, "easy")
    assert not laid_out_places("somebody's own", seed, "easy")


def test_every_manner_is_a_skill_of_its_own_and_tells_two_places() -> None:
    texts = [text for end in ENDS for side in SIDES for text in asked(end, side)]
    assert len({skill_of(text) for text in texts}) == len(texts) == 8
    codes = np.stack([stand_in(text, 128) for text in texts])
    likeness = np.corrcoef(codes[:, NUM_PLACE_FEATURES:])
    assert np.abs(likeness - np.eye(8)).max() < 0.75  # they share a second place, which is 0.36 of each


@given(st.integers(-9, 9), st.integers(-9, 9), st.integers(2, 4))
def test_of_the_second_place_the_direction_alone_is_told(down: int, right: int, times: int) -> None:
    pick = asked()[0].replace("<91, 134>", "<100, 100>")
    near, far = (pick.replace("<83, 127>", f"<{100 + n * down}, {100 + n * right}>") for n in (1, times))
    np.testing.assert_allclose(stand_in(near, 128), stand_in(far, 128), atol=1e-5)
    turned = pick.replace("<83, 127>", f"<{100 - right}, {100 + down}>")
    assert np.allclose(stand_in(near, 128), stand_in(turned, 128)) == (down == right == 0)


def test_a_mirrored_picture_shows_the_other_side_and_the_same_end() -> None:
    mirrors = Augmentation(max_shift_px=0, mirror=True)
    views = [draw_view(mirrors, FORM, set(asked()), np.random.default_rng(seed)) for seed in range(20)]
    assert {view.is_mirrored for view in views} == {True, False}
    mirrored = next(view for view in views if view.is_mirrored)
    assert mirrored.text("<60, 50>, <67, 55>") == "<60, 206>, <67, 201>"  # the same order
    assert mirrored.text(asked()[0]) == "Pick up the peg by grasping the far end at <91, 122>, <83, 129>, left side"
    sided = {"move to the top of the left-side target at <1, 2> for the first time"}
    assert not any(draw_view(mirrors, FORM, sided, np.random.default_rng(seed)).is_mirrored for seed in range(20))


def inserted_episode() -> TrainingEpisode:
    notes = [*[""] * 4, "far end <91, 134>, <83, 127>", *[""] * 5, "right side <111, 135>"]
    told = replace(episode(4, changes=(0, 2), num_demo=11), subgoals=[asked()[0]] * 2 + [asked()[1]] * 2)
    return replace(told, demo_subgoals=shown(), demo_notes=notes)


def test_what_a_blind_row_teaches_of_a_peg_stands_in_its_notes() -> None:
    manners = set()
    for seed in range(20):
        made = blind(inserted_episode(), seed)
        row, v = made.row(), NOTING.vocabulary
        assert made.frames() is None
        first = int(row.gate_index[0])
        noted, told = v.decode(row.ids[:first]), v.decode([token for token in row.targets[first:] if token >= 0])
        assert set(TOLD.findall(noted)) == set(TOLD.findall(told)), "both ends and the mouth"
        words = [re.findall(r"(?:far|near) end|(?:left|right) side", text) for text in (noted, told)]
        assert set(words[0]) == set(words[1])
        manners.add(tuple(words[0]))
    assert len(manners) == 4


def test_an_episode_told_otherwise_agrees_with_itself() -> None:
    inserted = inserted_episode()
    other = inserted.with_other_sides({1, 2})
    assert list(other.demo_subgoals) == shown("near", "left")
    assert [*dict.fromkeys(other.subgoals)] == asked("near", "left")
    assert narration(other.demo_subgoals) == ", ".join(note for note in other.demo_notes if note)
    for now, before in zip(other.subgoals, inserted.subgoals, strict=True):
        assert sorted(PLACE.findall(now)) == sorted(PLACE.findall(before))


def test_what_is_told_otherwise_of_a_peg_lies_where_it_lay() -> None:
    config = ExampleConfig(clocks=EVALUATION, narrates=True, has_plans=True, ways_by_sight=True, other_ways=1.0)
    v, manners = NOTING.vocabulary, set()
    shown = v.decode(blind(inserted_episode(), share=0.0).row().ids)
    for seed in range(20):
        row = make_example(inserted_episode(), NOTING, config, np.random.default_rng(seed)).row()
        told = v.decode(row.ids)
        assert set(TOLD.findall(told)) <= set(TOLD.findall(shown))
        manners.add(tuple(dict.fromkeys(re.findall(r"(?:far|near) end|(?:left|right) side", told))))
    assert len(manners) == 4


def test_a_peg_that_is_lifted_when_it_is_next_looked_at_has_one_note() -> None:
    notes = demo_notes(shown()[4:6], ["<88, 134>", "<111, 135>"], [""] * 2)
    assert notes == ["far end <91, 134>, <83, 127>", "right side <111, 135>"]


def test_a_peg_whose_texts_tell_one_place_has_it_noted() -> None:
    alone = ["Pick up the peg by grasping the far end at <91, 134>"] * 2
    assert demo_notes(alone, ["<90, 134>", "<60, 134>"], [""] * 2) == ["<91, 134>", "far end <91, 134>"]
