"""Rows of one look at a demonstration: what is noted at it is learned as in a whole row, and nothing after it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.sampling import EVALUATION, sample_schedule
from dual_system.models.ponder.context import IGNORE, Row
from dual_system.training.collate import collate_ponder
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import encode_rows
from dual_system.training.lapses import Lapses
from dual_system.training.places import PLACE
from dual_system.training.row_ends import is_noted_at_once, shortened
from dual_system.training.training_episode import TrainingEpisode
from tests.training.test_blind import NOTING
from tests.training.test_example import PONDER
from tests.training.test_insertions import inserted_episode

LIE = "<60, 50>, <67, 55>, <83, 127>, <91, 134>"
PLAIN = ExampleConfig(clocks=EVALUATION, narrates=True, has_plans=True)


def laid_out() -> TrainingEpisode:
    told = inserted_episode()
    return replace(told, demo_notes=[LIE, *list(told.demo_notes)[1:]])


def made(config: ExampleConfig, seed: int = 0, shown: TrainingEpisode | None = None) -> Example:
    return make_example(laid_out() if shown is None else shown, NOTING, config, np.random.default_rng(seed))


def learned(row: Row) -> str:
    return NOTING.vocabulary.decode([token for token in row.targets if token != IGNORE])


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_of_a_glance_the_first_note_is_learned_and_nothing_else(seed: int) -> None:
    lapses = Lapses(rows=1.0, missed=0.5, wrong=0.5, elsewhere=0.5)
    disturbed = replace(PLAIN, glances=1.0, text_dropout=1.0, slips=1.0, lapses=lapses, blind=1.0, other_ways=1.0)
    glance, whole = made(disturbed, seed), made(PLAIN, seed)
    assert glance.is_glance
    assert not whole.is_glance
    assert not glance.is_blind
    row = glance.row()
    told = learned(row)
    assert told == learned(made(replace(PLAIN, glances=1.0), seed).row())
    assert told.count("[") == len(PLACE.findall(LIE))
    assert learned(whole.row()).startswith(told)
    assert "end" not in told
    assert row.num_images == 2 * 2  # both cameras, at the first look and at the first query
    assert len(row.ids) < len(whole.row().ids) / 2


def test_a_glance_asks_nothing_of_cognition_and_its_places_are_lessons() -> None:
    glance = made(replace(PLAIN, glances=1.0))
    batch = collate_ponder([glance], stand_in_size=64, place_size=PONDER.hidden_size)
    assert batch.stand_in_weights[0].tolist() == [0.0]
    lessons = batch.place_lessons[0]
    assert len(lessons.index_M)
    assert int(lessons.index_M.max()) < glance.row().gate_index[0]
    (hidden_TH,) = encode_rows(PONDER, batch)
    assert len(hidden_TH) == len(glance.row().ids)


def test_without_a_note_at_the_first_look_there_is_no_glance() -> None:
    noteless = inserted_episode()
    assert not is_noted_at_once(noteless)
    assert not made(replace(PLAIN, glances=1.0), shown=noteless).is_glance
    bare = replace(laid_out(), demo=(), demo_notes=(), demo_subgoals=())
    assert not is_noted_at_once(bare)
    followed = replace(laid_out(), demo_notes=["<60, 50>"] * len(noteless.demo))
    assert not is_noted_at_once(followed)
    assert is_noted_at_once(laid_out())


def test_the_share_of_glances_is_the_one_asked_for() -> None:
    drawn = [made(replace(PLAIN, glances=0.3), seed).is_glance for seed in range(200)]
    assert 0.2 < np.mean(drawn) < 0.4
    with pytest.raises(ValueError, match="glances must be in"):
        ExampleConfig(clocks=EVALUATION, glances=1.5)


@given(seed=st.integers(0, 2**32 - 1), num=st.integers(1, 12))
def test_a_shortened_schedule_begins_as_the_whole_one_does(seed: int, num: int) -> None:
    whole = sample_schedule(np.random.default_rng(seed), EVALUATION, 200)
    short = shortened(whole, num)
    assert short.queries == whole.queries[:num]
    assert short.invocations == whole.invocations[: len(short.invocations)]
    if num < len(whole.queries):
        assert all(each.tick < whole.queries[num].tick for each in short.invocations)
    assert shortened(whole, None) is whole
