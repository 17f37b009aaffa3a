"""Prefetched batches are those that would have been made, from whichever step on."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.context import Row
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training.joint import PonderBatch, PounceBatch
from dual_system.training.prefetch import Prefetcher

POUNCE = random_pounce(tiny_cpu(), seed=0)


def made(step: int) -> tuple[PonderBatch, PounceBatch]:
    if step == 7:
        raise ValueError("step 7 has no batch")
    row = Row(
        ids=(1, 2, step),
        targets=(-100, 2, step),
        carrier_index=np.array([[1]]),
        num_images=1,
    )
    episodes = PonderBatch(
        rows=(row, row),
        frames=(torch.full((1, 2, 2, 3), step, dtype=torch.uint8), None),
    )
    invocations = PounceBatch(
        inputs=replace(POUNCE.config.example_inputs(2), cognition=None),
        actions_INA=POUNCE.config.example_actions(2) + step,
        episode_I=torch.tensor([0, 1]),
        query_I=torch.tensor([0, 0]),
    )
    return episodes, invocations


@pytest.fixture
def prefetcher() -> Iterator[Prefetcher]:
    found = Prefetcher(made, "cpu", 2)
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
        (one[1].actions_INA, other[1].actions_INA),
        (one[1].query_I, other[1].query_I),
    ]
    for left, right in pairs:
        assert left.dtype == right.dtype
        assert torch.equal(left, right)
    assert type(one[1].inputs) is type(other[1].inputs)


def test_they_come_in_order_and_are_the_same(prefetcher: Prefetcher) -> None:
    for step in range(5):
        same(prefetcher(step), made(step))


def test_a_resumed_run_begins_where_it_wants_to(prefetcher: Prefetcher) -> None:
    same(prefetcher(3), made(3))
    same(prefetcher(4), made(4))
    same(prefetcher(1), made(1))
    same(prefetcher(2), made(2))


def test_what_goes_wrong_there_is_said_here(prefetcher: Prefetcher) -> None:
    same(prefetcher(6), made(6))
    with pytest.raises(ValueError, match="step 7 has no batch"):
        prefetcher(7)


def test_somebody_must_make_them() -> None:
    with pytest.raises(ValueError, match="at least one process"):
        Prefetcher(made, "cpu", 0)


def test_workers_outlive_the_signals_of_their_process_group(prefetcher: Prefetcher) -> None:
    """Schedulers and torchrun send SIGTERM to all of them, and the trainer has a step to save first."""
    same(prefetcher(0), made(0))
    workers = multiprocessing.active_children()
    assert len(workers) == 2
    for number in (signal.SIGTERM, signal.SIGINT):
        for worker in workers:
            assert worker.pid is not None
            os.kill(worker.pid, number)
    for step in range(1, 6):  # more than were prefetched
        same(prefetcher(step), made(step))
    assert all(worker.is_alive() for worker in workers)
