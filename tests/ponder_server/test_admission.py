"""Who is admitted keeps the promise made to everybody; who is not hears why."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ponder_server.admission import MAX_LOAD, Admission
from ponder_server.contract import SessionError

MS = 1_000_000


@given(
    fire_ms=st.integers(1, 300), budget_ms=st.integers(1, 1000), periods_ms=st.lists(st.integers(50, 2000), max_size=12)
)
def test_admitted_sessions_always_fit_together(fire_ms: int, budget_ms: int, periods_ms: list[int]) -> None:
    admission = Admission(fire_ns=fire_ms * MS, latency_budget_ns=budget_ms * MS)
    for index, period_ms in enumerate(periods_ms):
        before = dict(admission.periods_ns)
        try:
            admission.admit(str(index), period_ms * MS)
        except SessionError:
            assert admission.periods_ns == before
    assert len(admission.periods_ns) * fire_ms <= budget_ms
    assert sum(fire_ms * MS / period_ns for period_ns in admission.periods_ns.values()) <= MAX_LOAD + 1e-9


def test_a_refusal_says_which_limit() -> None:
    admission = Admission(fire_ns=100 * MS, latency_budget_ns=250 * MS)
    admission.admit("a", 1000 * MS)
    with pytest.raises(SessionError, match=r"'b' is refused: a query every 125 ms beside 1 others is a load of 90% at"):
        admission.admit("b", 125 * MS)
    admission.admit("b", 1000 * MS)
    with pytest.raises(SessionError, match="with 2 others a query may take 300 ms, and the latency budget is 250 ms"):
        admission.admit("c", 1000 * MS)
    admission.release("a")
    admission.admit("c", 1000 * MS)


def test_a_session_opened_again_is_not_counted_twice() -> None:
    admission = Admission(fire_ns=100 * MS, latency_budget_ns=100 * MS)
    admission.admit("a", 1000 * MS)
    admission.admit("a", 1000 * MS)
    assert set(admission.periods_ns) == {"a"}
