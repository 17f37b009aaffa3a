"""Batches made ahead are those that would have been made: whoever makes them, and from whichever step on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.context import Row
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training.ahead import Ahead
from dual_system.training.joint import PonderBatch, PounceBatch
from dual_system.training.place_lessons import PlaceLessons

POUNCE = random_pounce(tiny_cpu(), seed=0)


def made(step: int) -> tuple[PonderBatch, PounceBatch]:
    if step == 7:
        raise ValueError("step 7 has no batch")
    row = Row(
        ids=(1, 2, step),
        targets=(-100, 2, step),
        carrier_index=np.array([[1]]),
        gate_index=np.array([2]),
        num_images=1,
    )
    episodes = PonderBatch(
        rows=(row, row),
        frames=(torch.full((1, 2, 2, 3), step, dtype=torch.uint8), None),
        stand_ins=(torch.full((1, 4), float(step)), torch.zeros(1, 4)),
        stand_in_weights=(torch.ones(1), torch.ones(1)),
        place_lessons=tuple(
            PlaceLessons(torch.tensor([0, step]), torch.tensor([0, 0]), torch.zeros(2, 3)) for _ in range(2)
        ),
    )
    invocations = PounceBatch(
        inputs=replace(POUNCE.config.example_inputs(2), cognition=None),
        actions_INA=POUNCE.config.example_actions(2) + step,
        episode_I=torch.tensor([0, 1]),
        query_I=torch.tensor([0, 0]),
    )
    return episodes, invocations


@pytest.fixture
def ahead() -> Iterator[Ahead]:
    found = Ahead(made, "cpu", 2)
    yield found
    found.close()


def same(one: tuple[PonderBatch, PounceBatch], other: tuple[PonderBatch, PounceBatch]) -> None:
    for mine, theirs in zip(one[0].rows, other[0].rows, strict=True):
        assert (mine.ids, mine.targets, mine.num_images) == (theirs.ids, theirs.targets, theirs.num_images)
        assert isinstance(mine.carrier_index, np.ndarray)
        np.testing.assert_array_equal(mine.carrier_index, theirs.carrier_index)
    assert one[0].frames[1] is None
    assert one[0].frames[0] is not None
    assert other[0].frames[0] is not None
    pairs = [
        (one[0].frames[0], other[0].frames[0]),
        *zip(one[0].stand_ins, other[0].stand_ins, strict=True),
        *zip(one[0].stand_in_weights, other[0].stand_in_weights, strict=True),
        *zip(one[0].place_lessons[1], other[0].place_lessons[1], strict=True),
        (one[1].actions_INA, other[1].actions_INA),
        (one[1].query_I, other[1].query_I),
    ]
    for left, right in pairs:
        assert left.dtype == right.dtype
        assert torch.equal(left, right)
    assert type(one[0].place_lessons[0]) is PlaceLessons
    assert type(one[1].inputs) is type(other[1].inputs)


def test_they_come_in_order_and_are_the_same(ahead: Ahead) -> None:
    for step in range(5):
        same(ahead(step), made(step))


def test_a_resumed_run_begins_where_it_wants_to(ahead: Ahead) -> None:
    same(ahead(3), made(3))
    same(ahead(4), made(4))
    same(ahead(1), made(1))
    same(ahead(2), made(2))


def test_what_goes_wrong_there_is_said_here(ahead: Ahead) -> None:
    same(ahead(6), made(6))
    with pytest.raises(ValueError, match="step 7 has no batch"):
        ahead(7)


def test_somebody_must_make_them() -> None:
    with pytest.raises(ValueError, match="at least one process"):
        Ahead(made, "cpu", 0)
