"""Who is admitted keeps every schedule that was admitted before; who is not hears why."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from clock.feasibility import check_feasible
from pounce_server.admission import Admission, room_of
from protocol.errors import EpisodeRefused
from protocol.messages import Mode, Schedule

MS = 1_000_000
every_ticks = st.integers(1, 20)


def invoked(ticks: int, mode: Mode = Mode.REALTIME) -> Schedule:
    return replace(schedules.realtime(), invoke_period_ticks=ticks, mode=mode)


@given(batch_ms=st.lists(st.integers(1, 400), min_size=1, max_size=5), wanted=st.lists(every_ticks, max_size=20))
def test_with_all_who_are_admitted_every_schedule_is_feasible(batch_ms: list[int], wanted: list[int]) -> None:
    admission = Admission(batch_ns={1 << power: ms * MS for power, ms in enumerate(sorted(batch_ms))})
    for index, ticks in enumerate(wanted):
        before = dict(admission.admitted)
        try:
            admission.admit(str(index), invoked(ticks))
        except EpisodeRefused:
            assert admission.admitted == before
            assert before
    worst_ns = admission.worst_ns(len(admission.admitted)) if len(admission.admitted) > 1 else 0
    for each in admission.admitted.values():
        starves_anyway = each.invoke_period_ticks == each.horizon
        assert starves_anyway or check_feasible(each, worst_ns).is_feasible or not worst_ns
        assert worst_ns <= room_of(each)


@given(num_robots=st.integers(1, 40), max_rows=st.sampled_from([1, 2, 4, 8]))
def test_the_worst_wait_is_that_of_a_queue_played_out(num_robots: int, max_rows: int) -> None:
    """All are invoked just after a batch of the others has begun, and this robot's turn comes last."""
    admission = Admission(batch_ns={size: (10 + size) * MS for size in range(1, max_rows + 1)})
    busy = min(num_robots - 1, max_rows)
    waited_ns, left = (10 + busy) * MS if busy else 0, num_robots
    while left:
        taken = min(left, max_rows)
        waited_ns += (10 + taken) * MS
        left -= taken
    assert admission.worst_ns(num_robots) == waited_ns


def test_a_refusal_names_the_schedule_that_could_not_be_kept() -> None:
    admission = Admission(batch_ns={1: 25 * MS, 2: 40 * MS, 4: 70 * MS})
    admission.admit("tight", invoked(2))
    admission.admit("easy", invoked(10))
    with pytest.raises(EpisodeRefused, match=r"'third' is refused: .* 2 others .* 110 ms, and the schedule of 'tight'"):
        admission.admit("third", invoked(10))
    admission.release("tight")
    admission.admit("third", invoked(10))


def test_in_lockstep_nobody_is_refused() -> None:
    admission = Admission(batch_ns={1: 10_000 * MS})
    for index in range(4):
        admission.admit(str(index), invoked(1, Mode.LOCKSTEP))
    with pytest.raises(EpisodeRefused):  # and they do not have to wait for it
        admission.admit("live", invoked(10))


def test_a_robot_that_is_alone_is_the_clocks_to_judge() -> None:
    Admission(batch_ns={1: 10_000 * MS}).admit("r0", invoked(1))
