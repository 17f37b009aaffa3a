"""The offset between two clocks is known to within its bound, whatever the network does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.offset import Offset, from_exchange, narrowest

MS = 1_000_000
OFFSETS = st.integers(-(10**15), 10**15)
WAYS = st.integers(0, 2 * 10**9)


def exchange(offset_ns: int, t0_ns: int, there_ns: int, work_ns: int, back_ns: int) -> Offset:
    """What we compute when their clock is ahead of ours by ``offset_ns``."""
    t1_ns = t0_ns + there_ns + offset_ns
    t2_ns = t1_ns + work_ns
    return from_exchange(t0_ns, t1_ns, t2_ns, t2_ns - offset_ns + back_ns)


@given(offset_ns=OFFSETS, t0_ns=OFFSETS, there=WAYS, work=WAYS, back=WAYS)
def test_the_truth_is_within_the_bound(offset_ns: int, t0_ns: int, there: int, work: int, back: int) -> None:
    found = exchange(offset_ns, t0_ns, there, work, back)
    assert abs(found.offset_ns - offset_ns) <= found.bound_ns


@given(offset_ns=OFFSETS, t0_ns=OFFSETS, there=WAYS, work=WAYS, back=WAYS)
def test_the_bound_is_half_the_round_trip(offset_ns: int, t0_ns: int, there: int, work: int, back: int) -> None:
    assert 0 <= exchange(offset_ns, t0_ns, there, work, back).bound_ns - (there + back) / 2 <= 1.5


@given(offset_ns=OFFSETS, there=WAYS)
def test_a_symmetric_way_gives_the_truth(offset_ns: int, there: int) -> None:
    assert abs(exchange(offset_ns, 0, there, 0, there).offset_ns - offset_ns) <= 1


@given(ways=st.lists(st.tuples(WAYS, WAYS), min_size=1, max_size=8))
@pytest.mark.parametrize("skew_ms", [-50, 50])
def test_the_narrowest_of_several_still_contains_the_truth(skew_ms: int, ways: list[tuple[int, int]]) -> None:
    found = [exchange(skew_ms * MS, k * 10**9, there, 0, back) for k, (there, back) in enumerate(ways)]
    best = narrowest(found)
    assert best.bound_ns == min(offset.bound_ns for offset in found)
    assert abs(best.offset_ns - skew_ms * MS) <= best.bound_ns


@pytest.mark.parametrize("skew_ms", [-50, 50])
def test_a_quiet_loopback_finds_50_ms_to_within_a_tenth(skew_ms: int) -> None:
    ways = [(900_000, 100_000), (80_000, 60_000), (3_000_000, 50_000)]
    found = narrowest(exchange(skew_ms * MS, 0, there, 5_000, back) for there, back in ways)
    assert abs(found.offset_ns - skew_ms * MS) <= found.bound_ns <= MS // 10


@given(offset_ns=OFFSETS, instant_ns=OFFSETS)
def test_their_instants_become_ours(offset_ns: int, instant_ns: int) -> None:
    assert Offset(offset_ns=offset_ns, bound_ns=0).to_ours(instant_ns + offset_ns) == instant_ns


@pytest.mark.parametrize("instants", [(10, 0, 0, 9), (0, 5, 4, 10), (0, 0, 11, 10)])
def test_an_impossible_exchange_is_refused(instants: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match="impossible exchange: t0"):
        from_exchange(*instants)
