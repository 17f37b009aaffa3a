"""Training pairs as serving pairs."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from clock import sampling
from clock.reference import Reference, latest_ready
from clock.sampling import EVALUATION, ROBOMME, Clocks, LogNormal, SampledSchedule, sample_schedule
from protocol import messages as m

MS = 1_000_000

SEEDS = st.integers(0, 2**32 - 1)
INTERVALS = st.builds(LogNormal, mean_ns=st.integers(20 * MS, 3_000 * MS), sigma=st.floats(0, 0.6))
DELAYS = st.builds(LogNormal, mean_ns=st.integers(1, 4_000 * MS), sigma=st.floats(0, 0.6))
CLOCKS = st.builds(Clocks, query=INTERVALS, invoke=INTERVALS, delay=DELAYS)


def drawn(seed: int, clocks: Clocks, num_ticks: int, **options: object) -> SampledSchedule:
    return sample_schedule(np.random.default_rng(seed), clocks, num_ticks, **options)  # type: ignore[arg-type]


@given(
    query_ms=st.integers(50, 2_500),
    invoke_ticks=st.integers(1, 12),
    delay_ms=st.integers(1, 3_000),
    num_ticks=st.integers(1, 90),
)
@example(query_ms=4_000, invoke_ticks=16, delay_ms=300, num_ticks=200)  # RoboCasa-DC: chunks of 16 rows, played in full
@example(query_ms=60_000, invoke_ticks=16, delay_ms=300, num_ticks=200)  # and one cognition an episode
def test_without_spread_the_sampled_schedule_is_the_served_one(
    timing: Callable[..., m.Schedule],
    lockstep: Callable[..., Any],
    query_ms: int,
    invoke_ticks: int,
    delay_ms: int,
    num_ticks: int,
) -> None:
    fixed = [m.Delay(kind=m.DelayKind.FIXED, mean_ns=delay_ms * MS), m.Delay(kind=m.DelayKind.FIXED)]
    asked = timing(
        query_period_ns=query_ms * MS, invoke_period_ticks=invoke_ticks, query_delay=fixed[0], invoke_delay=fixed[1]
    )
    served = lockstep(asked, num_ticks, seed=num_ticks)
    clocks = Clocks(
        query=LogNormal(mean_ns=query_ms * MS),
        invoke=LogNormal(mean_ns=invoke_ticks * 50 * MS),
        delay=LogNormal(mean_ns=delay_ms * MS),
    )
    sampled = drawn(0, clocks, num_ticks)
    queries = [(q.tick, q.source_ns) for q in served.of(m.Query)]
    assert [(q.tick, q.stamp.source_ns) for q in sampled.queries] == queries
    invocations = [(i.tick, i.now_ns, Reference(query=i.ref_query, age_ns=i.age_ns)) for i in served.of(m.Invocation)]
    assert [(i.tick, i.now_ns, i.reference) for i in sampled.invocations] == invocations


@given(seed=SEEDS, clocks=CLOCKS, num_ticks=st.integers(1, 200))
def test_laws_of_a_drawn_schedule(seed: int, clocks: Clocks, num_ticks: int) -> None:
    sampled = drawn(seed, clocks, num_ticks)
    stamps = [query.stamp for query in sampled.queries]
    assert [stamp.query for stamp in stamps] == list(range(len(stamps)))
    assert all(a.ready_ns <= b.ready_ns for a, b in itertools.pairwise(stamps))
    assert all(stamp.source_ns <= stamp.ready_ns for stamp in stamps)
    for ticks in ([q.tick for q in sampled.queries], [i.tick for i in sampled.invocations]):
        assert ticks[0] == 0
        assert ticks == sorted(set(ticks))
        assert ticks[-1] < num_ticks
    for invocation in sampled.invocations:
        newest = latest_ready(stamps, invocation.now_ns)
        assert newest is not None  # control starts with the first cognition
        assert invocation.reference == Reference(query=newest.query, age_ns=invocation.now_ns - newest.source_ns)


@given(seed=SEEDS, num_ticks=st.integers(1, 400))
def test_in_evaluation_every_age_is_300_ms(seed: int, num_ticks: int) -> None:
    assert {i.reference.age_ns for i in drawn(seed, EVALUATION, num_ticks).invocations} == {300 * MS}


@given(seed=SEEDS)
def test_a_seed_draws_one_schedule(seed: int) -> None:
    assert drawn(seed, ROBOMME, 100) == drawn(seed, ROBOMME, 100)


def test_training_shows_each_state_at_several_ages() -> None:
    ages_ms = [i.reference.age_ns / MS for seed in range(20) for i in drawn(seed, ROBOMME, 300).invocations]
    assert min(ages_ms) < 350
    assert 1_200 < max(ages_ms) < 2_200
    assert 9 < 20 * 15 * 10 / len(ages_ms) * 10 < 12  # 15 s at 10 Hz, rounded up to ticks: 7 to 10 a second


def test_a_transition_belongs_to_the_first_query_that_sees_it() -> None:
    sampled = drawn(0, EVALUATION, 100, transition_ticks=frozenset({15, 35, 36}))
    assert [(q.tick, q.stamp.is_transition) for q in sampled.queries] == [
        (0, True), (14, False), (34, True), (54, True), (74, False), (94, False),
    ]  # fmt: skip


def test_a_null_delivery_gives_nobody_anything() -> None:
    sampled = drawn(0, ROBOMME, 50, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    assert {i.reference for i in sampled.invocations} == {Reference(query=None, age_ns=0)}


def test_no_ticks_no_schedule() -> None:
    with pytest.raises(ValueError, match="at least one"):
        drawn(0, ROBOMME, 0)


def test_the_papers_numbers() -> None:
    assert (ROBOMME.query.mean_ns, ROBOMME.query.sigma) == (1_000 * MS, 0.05)
    assert (ROBOMME.invoke.mean_ns, ROBOMME.invoke.sigma) == (100 * MS, 0.05)
    assert (ROBOMME.delay.mean_ns, ROBOMME.delay.sigma) == (300 * MS, 0.3)
    assert replace(sampling.ROBOCASA_DC, query=ROBOMME.query, invoke=ROBOMME.invoke) == ROBOMME
