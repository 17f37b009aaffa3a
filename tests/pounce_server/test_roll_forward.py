"""A chunk from the state that the committed rows lead to, laid out from the observation's tick on as any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu
from pounce_server.contract import Request, example_request
from pounce_server.engine import EagerEngine
from pounce_server.roll_forward import placed, rolled

N = 20


@pytest.fixture(scope="module")
def plain() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_cpu(), seed=0))


@pytest.fixture(scope="module")
def engine() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_cpu(), seed=0), rolls_forward=True)


@pytest.fixture(scope="module")
def request_(plain: EagerEngine) -> Request:
    return replace(example_request(plain.spec), previous_rows=None, committed_rows=0)


def with_tail(request: Request, num_previous: int, committed: int, row0: int, seed: int = 0) -> Request:
    rows = np.random.default_rng(seed).uniform(-0.3, 0.3, (num_previous, 8)).astype(np.float32)
    return replace(request, previous_rows=rows, committed_rows=min(committed, num_previous), previous_row0=row0)


def test_without_committed_rows_it_is_the_plain_engine_bit_for_bit(
    engine: EagerEngine, plain: EagerEngine, request_: Request
) -> None:
    for asked in (request_, with_tail(request_, 8, 0, 1)):
        np.testing.assert_array_equal(engine.invoke(asked), plain.invoke(asked))


@given(
    num_previous=st.integers(1, N), committed=st.integers(1, N), row0=st.integers(0, 25), seed=st.integers(0, 2**32 - 1)
)
@settings(max_examples=25, deadline=None)
def test_the_chunk_is_the_committed_rows_and_then_a_plan_from_where_they_lead(
    plain: EagerEngine, engine: EagerEngine, request_: Request, num_previous: int, committed: int, row0: int, seed: int
) -> None:
    asked = with_tail(request_, num_previous, committed, row0, seed)
    rows = engine.invoke(asked)
    assert asked.previous_rows is not None
    ahead = min(row0 + asked.committed_rows, N - 1)
    num_played = ahead - row0
    assert rows.shape == (N, 8)
    if num_played <= 0:  # the observation is so late that every settled row is past
        np.testing.assert_array_equal(rows, plain.invoke(asked))
        return
    np.testing.assert_array_equal(rows[row0:ahead], asked.previous_rows[:num_played])
    there = np.append(asked.previous_rows[num_played - 1, :7], request_.proprio[7])
    np.testing.assert_array_equal(rows[ahead:], plain.invoke(replace(request_, proprio=there))[: N - ahead])


def test_several_robots_roll_each_their_own_way(engine: EagerEngine, request_: Request) -> None:
    robots = [with_tail(request_, 6, 2, 0), request_, with_tail(request_, 9, 4, 1, seed=1)]
    for together, robot in zip(engine.invoke_many(robots), robots, strict=True):
        np.testing.assert_allclose(together, engine.invoke(robot), rtol=0, atol=1e-4)


def test_a_request_rolls_once(request_: Request) -> None:
    asked = with_tail(request_, 8, 3, 1)
    once = rolled(asked, N)
    assert rolled(once, N) is once
    assert once.previous_rows is not None
    assert len(once.previous_rows) == 5
    rows = np.zeros((N, 8), np.float32)
    assert placed(rows, once) is rows


def test_two_ways_of_minding_committed_rows_are_refused() -> None:
    config = replace(tiny_cpu(), max_committed_rows=4)
    with pytest.raises(ValueError, match="take one"):
        EagerEngine(random_bundle(config, seed=0), continuity="trained", rolls_forward=True)
