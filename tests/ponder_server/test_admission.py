"""Who is admitted keeps the promise made to everybody; who is not hears why."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from ponder_server.admission import MAX_LOAD, Admission
from ponder_server.contract import SessionError
from protocol.messages import Schedule

MS = 1_000_000


def asks(period_ms: int, max_age_ms: int) -> Schedule:
    return replace(schedules.realtime(), query_period_ns=period_ms * MS, max_age_ns=max_age_ms * MS)


@given(
    fire_ms=st.tuples(st.integers(1, 300), st.integers(1, 300)).map(sorted),
    wanted=st.lists(st.tuples(st.integers(50, 2000), st.integers(1, 4000), st.booleans()), max_size=12),
)
def test_nobody_admitted_grows_older_than_it_allows(fire_ms: list[int], wanted: list[tuple[int, int, bool]]) -> None:
    p50_ns, p99_ns = (ms * MS for ms in fire_ms)
    admission = Admission(fire_p50_ns=p50_ns, fire_p99_ns=p99_ns)
    for index, (period_ms, max_age_ms, waits) in enumerate(wanted):
        before = dict(admission.admitted)
        schedule = asks(period_ms, max_age_ms)
        try:
            admission.admit(str(index), replace(schedule, mode=schedules.paper().mode) if waits else schedule)
        except SessionError:
            assert admission.admitted == before
            assert not waits or any(each.mode == schedule.mode for each in before.values())
    in_time = [each for each in admission.admitted.values() if each.mode == schedules.realtime().mode]
    for each in in_time:
        oldest_ns = each.query_period_ns + (len(admission.admitted) - 1) * p50_ns + p99_ns
        assert oldest_ns <= each.max_age_ns
    assert sum(p50_ns / each.query_period_ns for each in in_time) <= MAX_LOAD + 1e-9


@pytest.mark.parametrize("num_sessions", [1, 4, 32])
def test_the_first_robot_over_the_age_is_the_one_refused(num_sessions: int) -> None:
    admission = Admission(fire_p50_ns=20 * MS, fire_p99_ns=35 * MS)
    schedule = asks(1000, 1000 + (num_sessions - 1) * 20 + 35)
    for index in range(num_sessions):
        admission.admit(f"r{index}", schedule)
    with pytest.raises(SessionError, match=f"'one more' is refused: with {num_sessions} others a query may take"):
        admission.admit("one more", schedule)


def test_a_robot_is_refused_for_the_age_of_another_ones_cognition() -> None:
    admission = Admission(fire_p50_ns=100 * MS, fire_p99_ns=100 * MS)
    admission.admit("strict", asks(1000, 1100))
    with pytest.raises(SessionError, match="cognition of 'strict', which asks every 1000 ms, would be older than"):
        admission.admit("easy", asks(1000, 9000))


def test_a_refusal_says_which_limit() -> None:
    admission = Admission(fire_p50_ns=100 * MS, fire_p99_ns=100 * MS)
    admission.admit("a", asks(1000, 1250))
    with pytest.raises(SessionError, match=r"'b' is refused: a query every 125 ms beside 1 others is a load of 90% at"):
        admission.admit("b", asks(125, 2000))
    admission.admit("b", asks(1000, 1250))
    with pytest.raises(SessionError, match=r"others a query may take 300 ms once contexts are full, .*max-age-ms 1250"):
        admission.admit("c", asks(1000, 1250))
    admission.release("a")
    admission.admit("c", asks(1000, 1250))


def test_a_robot_opened_again_is_not_counted_twice() -> None:
    admission = Admission(fire_p50_ns=100 * MS, fire_p99_ns=100 * MS)
    admission.admit("a", asks(1000, 1100))
    admission.admit("a", asks(1000, 1100))
    assert set(admission.admitted) == {"a"}
