"""ref(j) = max{t : tau_t + d_t <= tau_j} (paper, section 3.3), and the interventions of section 5.2."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.reference import NULL, Ready, Reference, age_ns, held_at_transition, latest_ready, refer
from protocol.messages import Delivery, DeliveryKind

MS = 1_000_000
EVERY = Delivery(kind=DeliveryKind.EVERY)
HELD = Delivery(kind=DeliveryKind.HELD_TRANSITION)
NULL_DELIVERY = Delivery(kind=DeliveryKind.NULL)

NOW = st.integers(0, 30_000 * MS)


@st.composite
def stamps(draw: st.DrawFn) -> list[Ready]:
    """Queries in order of looking, each with a delay of its own: a later one may be ready first."""
    intervals = draw(st.lists(st.integers(1, 2_000 * MS), max_size=10))
    source_ns, made = 0, []
    for query, interval_ns in enumerate(intervals):
        source_ns += interval_ns
        ready_ns = source_ns + draw(st.integers(0, 3_000 * MS))
        made.append(Ready(query=query, source_ns=source_ns, ready_ns=ready_ns, is_transition=draw(st.booleans())))
    return draw(st.permutations(made))


def ready(query: int, source_ms: int, delay_ms: int, *, is_transition: bool = False) -> Ready:
    return Ready(
        query=query, source_ns=source_ms * MS, ready_ns=(source_ms + delay_ms) * MS, is_transition=is_transition
    )


@given(stamps=stamps(), now_ns=NOW)
def test_the_reference_is_the_newest_query_that_is_ready(stamps: list[Ready], now_ns: int) -> None:
    allowed = [s.query for s in stamps if s.source_ns + (s.ready_ns - s.source_ns) <= now_ns]
    assert refer(stamps, now_ns, EVERY).query == (max(allowed) if allowed else None)


@given(stamps=stamps(), now_ns=NOW, delivery=st.sampled_from([EVERY, HELD, NULL_DELIVERY]))
def test_an_age_is_never_negative(stamps: list[Ready], now_ns: int, delivery: Delivery) -> None:
    assert refer(stamps, now_ns, delivery).age_ns >= 0


@given(stamps=stamps(), now_ns=NOW)
def test_an_age_is_at_least_the_delay(stamps: list[Ready], now_ns: int) -> None:
    ref = latest_ready(stamps, now_ns)
    assert ref is None or age_ns(ref, now_ns) >= ref.ready_ns - ref.source_ns


@given(stamps=stamps(), times=st.lists(NOW, min_size=2, max_size=8).map(sorted))
@pytest.mark.parametrize("delivery", [EVERY, HELD], ids=["every", "held"])
def test_references_never_go_backwards(delivery: Delivery, stamps: list[Ready], times: list[int]) -> None:
    queries = [refer(stamps, now_ns, delivery).query for now_ns in times]
    assert all((-1 if a is None else a) <= (-1 if b is None else b) for a, b in pairwise(queries))


@given(stamps=stamps(), now_ns=NOW, later_ns=st.integers(1, 1_000 * MS))
def test_the_same_reference_ages_as_time_passes(stamps: list[Ready], now_ns: int, later_ns: int) -> None:
    before, after = refer(stamps, now_ns, EVERY), refer(stamps, now_ns + later_ns, EVERY)
    assert before.query is None or before.query != after.query or after.age_ns - before.age_ns == later_ns


@given(stamps=stamps(), now_ns=NOW)
def test_a_reference_does_not_depend_on_what_is_not_ready(stamps: list[Ready], now_ns: int) -> None:
    assert refer(stamps, now_ns, EVERY) == refer([s for s in stamps if s.ready_ns <= now_ns], now_ns, EVERY)


def test_null_cognition_has_age_zero() -> None:
    assert refer([], 5_000 * MS, EVERY) == NULL == Reference(query=None, age_ns=0)


def test_nothing_ready_yet_is_null() -> None:
    assert refer([ready(0, 0, 300)], 300 * MS - 1, EVERY) == NULL


def test_readiness_includes_the_very_instant() -> None:
    assert refer([ready(0, 0, 300)], 300 * MS, EVERY) == Reference(query=0, age_ns=300 * MS)


def test_a_slow_query_never_hides_a_newer_one_that_is_ready() -> None:
    slow, quick = ready(0, 0, 5_000), ready(1, 1_000, 100)
    assert refer([slow, quick], 2_000 * MS, EVERY).query == 1


def test_a_slow_query_does_not_replace_a_newer_one_when_it_comes() -> None:
    assert refer([ready(0, 0, 5_000), ready(1, 1_000, 100)], 6_000 * MS, EVERY).query == 1


def test_the_paper_evaluates_at_an_age_of_exactly_300_ms() -> None:
    stamps = [ready(t, 1_000 * t, 300) for t in range(20)]
    ages = {refer(stamps, (1_000 * t + 300) * MS, EVERY).age_ns for t in range(20)}
    assert ages == {300 * MS}


def test_age_counts_from_the_observation_and_not_from_the_answer() -> None:
    assert age_ns(ready(0, 1_000, 300), 1_900 * MS) == 900 * MS


# -- section 5.2: held transitions, and null


@given(stamps=stamps(), now_ns=NOW)
def test_held_delivers_the_first_and_transitions_only(stamps: list[Ready], now_ns: int) -> None:
    held = held_at_transition(stamps, now_ns)
    assert held is None or held.query == 0 or held.is_transition


@given(stamps=stamps(), now_ns=NOW)
def test_held_is_never_newer_than_the_newest(stamps: list[Ready], now_ns: int) -> None:
    held, newest = held_at_transition(stamps, now_ns), latest_ready(stamps, now_ns)
    assert held is None or (newest is not None and held.query <= newest.query)


def test_held_reuses_the_last_transition_until_the_next() -> None:
    stamps = [ready(t, 1_000 * t, 300, is_transition=t in (2, 5)) for t in range(8)]
    held = [refer(stamps, (1_000 * t + 300) * MS, HELD).query for t in range(8)]
    assert held == [0, 0, 2, 2, 2, 5, 5, 5]


def test_held_tells_the_true_age_unless_told_otherwise() -> None:
    stamps = [ready(0, 0, 300), ready(1, 1_000, 300)]
    assert refer(stamps, 1_300 * MS, HELD) == Reference(query=0, age_ns=1_300 * MS)


def test_the_papers_intervention_reports_a_frozen_age() -> None:
    frozen = Delivery(kind=DeliveryKind.HELD_TRANSITION, reported_age_ns=300 * MS)
    assert refer([ready(0, 0, 300)], 9_000 * MS, frozen) == Reference(query=0, age_ns=300 * MS)


@given(stamps=stamps(), now_ns=NOW, told_ms=st.integers(1, 5_000))
def test_another_age_is_told_of_the_same_content(stamps: list[Ready], now_ns: int, told_ms: int) -> None:
    told = refer(stamps, now_ns, Delivery(kind=DeliveryKind.EVERY, reported_age_ns=told_ms * MS))
    true = refer(stamps, now_ns, Delivery(kind=DeliveryKind.EVERY))
    assert told == (NULL if true == NULL else Reference(query=true.query, age_ns=told_ms * MS))


def test_a_frozen_age_is_not_told_of_null() -> None:
    frozen = Delivery(kind=DeliveryKind.HELD_TRANSITION, reported_age_ns=300 * MS)
    assert refer([], 9_000 * MS, frozen) == NULL


@given(stamps=stamps(), now_ns=NOW)
def test_null_delivery_is_null_whatever_is_ready(stamps: list[Ready], now_ns: int) -> None:
    assert refer(stamps, now_ns, NULL_DELIVERY) == NULL
