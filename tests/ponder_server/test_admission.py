"""Who is admitted keeps the promise made to everybody; who is not hears why."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ponder_server.admission import MAX_LOAD, Admission
from ponder_server.contract import SessionError

MS = 1_000_000


@given(
    fire_ms=st.tuples(st.integers(1, 300), st.integers(1, 300)).map(sorted),
    budget_ms=st.integers(1, 1000),
    periods_ms=st.lists(st.integers(50, 2000), max_size=12),
)
def test_admitted_sessions_always_fit_together(fire_ms: list[int], budget_ms: int, periods_ms: list[int]) -> None:
    p50_ns, p99_ns = (ms * MS for ms in fire_ms)
    admission = Admission(fire_p50_ns=p50_ns, fire_p99_ns=p99_ns, latency_budget_ns=budget_ms * MS)
    for index, period_ms in enumerate(periods_ms):
        before = dict(admission.periods_ns)
        try:
            admission.admit(str(index), period_ms * MS)
        except SessionError:
            assert admission.periods_ns == before
    if admission.periods_ns:
        assert (len(admission.periods_ns) - 1) * p50_ns + p99_ns <= budget_ms * MS
    assert sum(p50_ns / period_ns for period_ns in admission.periods_ns.values()) <= MAX_LOAD + 1e-9


@pytest.mark.parametrize("num_sessions", [1, 4, 32])
def test_the_first_session_over_the_budget_is_the_one_refused(num_sessions: int) -> None:
    admission = Admission(
        fire_p50_ns=20 * MS, fire_p99_ns=35 * MS, latency_budget_ns=((num_sessions - 1) * 20 + 35) * MS
    )
    for index in range(num_sessions):
        admission.admit(f"r{index}", 1000 * MS)
    with pytest.raises(SessionError, match=f"with {num_sessions} others a query may take"):
        admission.admit("one more", 1000 * MS)


def test_a_refusal_says_which_limit() -> None:
    admission = Admission(fire_p50_ns=100 * MS, fire_p99_ns=100 * MS, latency_budget_ns=250 * MS)
    admission.admit("a", 1000 * MS)
    with pytest.raises(SessionError, match=r"'b' is refused: a query every 125 ms beside 1 others is a load of 90% at"):
        admission.admit("b", 125 * MS)
    admission.admit("b", 1000 * MS)
    with pytest.raises(SessionError, match=r"others a query may take 300 ms once contexts are full, .* is 250 ms"):
        admission.admit("c", 1000 * MS)
    admission.release("a")
    admission.admit("c", 1000 * MS)


def test_a_session_opened_again_is_not_counted_twice() -> None:
    admission = Admission(fire_p50_ns=100 * MS, fire_p99_ns=100 * MS, latency_budget_ns=100 * MS)
    admission.admit("a", 1000 * MS)
    admission.admit("a", 1000 * MS)
    assert set(admission.periods_ns) == {"a"}
