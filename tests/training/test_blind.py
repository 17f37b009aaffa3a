"""Rows of words alone: notes of a demonstrated way at places that were never seen, and what follows from them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.ponder.context import IGNORE
from dual_system.training.blind import without_pictures
from dual_system.training.collate import collate_ponder
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import encode_rows
from dual_system.training.places import PLACE, TEXT_PX, scattered
from dual_system.training.training_episode import TrainingEpisode
from dual_system.training.ways import shows_a_way
from tests.training.test_example import FORM, PONDER, episode
from tests.training.test_ways import demonstrated_way

NOTING = replace(FORM, takes_notes=True)
AROUND = [("left", "clockwise", 93, 85), ("left", "counterclockwise", 84, 119), ("right", "clockwise", 90, 60)]
TOLD = re.compile(r"\[\d+, \d+\]")


def straight_way() -> TrainingEpisode:
    """Three stretches, two ticks of each, noted where each ends."""
    stretches = ["forward to <66, 172>", "left to <52, 148>", "back to <66, 100>"]
    following = [", then <52, 148>", ", then <66, 100>", ""]
    texts = [f"move {stretch}{then}" for stretch, then in zip(stretches, following, strict=True) for _ in range(2)]
    notes = [stretch.replace(" to", "") * (n % 2) for n, stretch in enumerate(np.repeat(stretches, 2).tolist())]
    shown = episode(6, changes=(0, 2, 4), num_demo=6)
    return replace(shown, subgoals=texts, demo_subgoals=texts, demo_notes=notes)


def noted_way() -> TrainingEpisode:
    """Around things; the end of a stretch is noted when it is reached."""
    way = demonstrated_way(AROUND)
    ends = [f" <{y}, {x}>" * (n % 2) for n, (_, _, y, x) in enumerate(np.repeat(np.array(AROUND, object), 2, axis=0))]
    return replace(way, demo_notes=[note + end for note, end in zip(way.demo_notes, ends, strict=True)])


def blind(shown: TrainingEpisode, seed: int = 0, share: float = 1.0) -> Example:
    config = ExampleConfig(clocks=EVALUATION, narrates=True, has_plans=True, ways_by_sight=True, blind=share)
    return make_example(shown, NOTING, config, np.random.default_rng(seed))


@given(seed=st.integers(0, 2**32 - 1), y=st.integers(0, 255), x=st.integers(0, 255))
def test_a_scattered_place_is_one_and_within_the_picture(seed: int, y: int, x: int) -> None:
    text = f"left <{y}, {x}>, 3 times, then <{y}, {x}>"
    moved = scattered(text, seed)
    first, second = PLACE.findall(moved)
    assert first == second
    assert all(32 <= int(value) < TEXT_PX - 32 for value in first)
    assert PLACE.sub("", moved) == PLACE.sub("", text)


def test_two_places_are_scattered_apart_and_otherwise_in_every_row() -> None:
    moved = {scattered(place, seed) for place in ("<10, 20>", "<20, 10>", "<10, 21>") for seed in range(20)}
    assert len(moved) > 55


@given(shown=st.sampled_from([straight_way(), noted_way()]), seed=st.integers(0, 99))
@settings(deadline=None)
def test_without_pictures_all_else_stands_in_its_order(shown: TrainingEpisode, seed: int) -> None:
    row = replace(blind(shown, seed), is_blind=False).row()
    pad = FORM.vocabulary.image_pad
    left = without_pictures(row, FORM.vocabulary)
    assert left.num_images == 0
    pairs = list(zip(row.ids, row.targets, strict=True))
    first = int(left.gate_index[0])
    expected = [pair for pair in pairs if pair[0] != pad]
    assert [*left.ids] == [id_ for id_, _ in expected]
    assert [*left.targets[first:]] == [target for _, target in expected[first:]]
    for before, after in ((row.carrier_index, left.carrier_index), (row.gate_index, left.gate_index)):
        assert before.shape == after.shape
        assert np.array_equal(np.asarray(row.ids)[before], np.asarray(left.ids)[after])
    assert FORM.positions(left.ids)[0][1].tolist() == list(range(len(left.ids)))


@pytest.mark.parametrize("shown", [straight_way(), noted_way()])
def test_what_is_to_be_learned_stands_in_the_notes(shown: TrainingEpisode) -> None:
    v = FORM.vocabulary
    for seed in range(5):
        made = blind(shown, seed)
        row = made.row()
        assert v.image_pad not in row.ids
        assert made.frames() is None
        first = int(row.gate_index[0])
        assert {*row.targets[: first + 1]} == {IGNORE}, "nor whether there is a note: nothing tells it"
        noted, planned = v.decode(row.ids[:first]), v.decode([t for t in row.targets[first:] if t >= 0])
        assert len(set(TOLD.findall(noted))) == 3
        assert set(TOLD.findall(planned)) == set(TOLD.findall(noted))
        assert len(made.schedule.queries) <= 2


def test_sides_of_notes_and_plan_are_drawn_together() -> None:
    v = FORM.vocabulary
    sides = set()
    for seed in range(12):
        text = v.decode(blind(noted_way(), seed).row().ids)
        stretches = dict(re.findall(r"(\d \w+) (backward|forward)", text))
        assert all((name, side) in stretches.items() for name, side in re.findall(r"(\d \w+) (backward|forward)", text))
        sides.add(tuple(stretches.items()))
    assert len(sides) > 3


def test_who_sees_nothing_is_asked_for_no_cognition_and_no_place_but_what_is_told() -> None:
    made = blind(noted_way())
    seeing = blind(noted_way(), share=0.0)
    batch = collate_ponder([seeing, made], stand_in_size=64, place_size=64)
    weights = [each.tolist() for each in batch.stand_in_weights]
    assert set(weights[0]) == {1.0}
    assert set(weights[1]) == {0.0}
    told = [target for target in batch.rows[1].targets if target != IGNORE]
    assert 0 < len(batch.place_lessons[1].index_M) < len(told)
    assert batch.frames[1] is None
    with torch.no_grad():
        hidden = encode_rows(PONDER, batch)
        alone = encode_rows(PONDER, collate_ponder([made]))
    assert torch.allclose(hidden[1], alone[0], atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_share_of_ways_is_blind_and_nothing_else(share: float) -> None:
    made = [blind(noted_way(), seed, share).is_blind for seed in range(60)]
    assert (15 < sum(made) < 45) if share else not any(made)
    still = replace(episode(6, num_demo=2), demo_subgoals=["pick up the cube at <9, 9>"] * 2)
    assert not shows_a_way(still.demo_subgoals)
    assert not any(blind(still, seed, 1.0).is_blind for seed in range(5))


def test_ways_around_nothing_can_be_spared() -> None:
    plain = ExampleConfig(clocks=EVALUATION, narrates=True, has_plans=True, ways_by_sight=True)
    otherwise = replace(plain, blind=0.6, other_ways=0.6, spares_bare_ways=True)
    for shown, is_spared in ((straight_way(), True), (noted_way(), False)):
        for seed in range(20):
            made, as_shown = (
                make_example(shown, NOTING, config, np.random.default_rng(seed)) for config in (otherwise, plain)
            )
            if is_spared:
                assert not made.is_blind
                assert made.row().ids == as_shown.row().ids
            elif made.is_blind:
                break
        assert made.is_blind != is_spared


def test_a_straight_way_told_otherwise_has_its_pictures_and_is_read_from_its_notes() -> None:
    v, shown = FORM.vocabulary, straight_way()
    config = ExampleConfig(clocks=EVALUATION, narrates=True, has_plans=True, other_ways=1.0, text_dropout=1.0)
    made = make_example(shown, NOTING, config, np.random.default_rng(0))
    row, frames = made.row(), made.frames()
    assert frames is not None
    assert len(frames) == row.num_images == 2 * (6 + len(made.schedule.queries))
    first = int(row.gate_index[0])
    noted, planned = v.decode(row.ids[:first]), v.decode([t for t in row.targets[first:] if t >= 0])
    assert set(TOLD.findall(planned)) == set(TOLD.findall(noted))
    assert not set(TOLD.findall(planned)) & set(TOLD.findall(v.decode(blind(shown, share=0.0).row().ids)))
    assert {*row.targets[:first]} == {IGNORE, v.t_yes, v.t_no}, "when a note is due is to be seen, and learned"
    assert not made.stand_in_weights(4.0).any()
    assert not any(made.place_lessons(row, 64).index_M < first)
