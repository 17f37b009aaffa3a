"""d <= s <= H - d: whether a schedule plays without a gap, compared with playing it."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from clock import schedules
from clock.feasibility import Feasibility, check_feasible, delay_ticks
from protocol.messages import Delay, DelayKind, Mode, Schedule

MS = 1_000_000
TICK_MS = 50


def starved_by_simulation(horizon: int, invoke_ticks: int, delay_ticks: int) -> int:
    """Ticks without a row between the first playable rows of two late invocations."""
    first = 61 * invoke_ticks  # after the longest delay: before the first playable row nothing is starved
    covered = {
        tick
        for j in range(80)
        for tick in range(j * invoke_ticks + delay_ticks, j * invoke_ticks + horizon)  # rows before d are past
    }
    return sum(tick not in covered for tick in range(first, first + invoke_ticks))


@given(horizon=st.integers(1, 50), invoke_ticks=st.integers(1, 60), delay=st.integers(0, 60))
@example(horizon=42, invoke_ticks=1, delay=41)
def test_starved_ticks_per_chunk_are_those_of_a_simulation(horizon: int, invoke_ticks: int, delay: int) -> None:
    found = Feasibility(horizon=horizon, invoke_ticks=invoke_ticks, delay_ticks=delay)
    expected = starved_by_simulation(horizon, invoke_ticks, delay)
    assert min(found.starved_ticks, invoke_ticks) == expected


@given(horizon=st.integers(1, 50), invoke_ticks=st.integers(1, 60), delay=st.integers(0, 60))
def test_a_feasible_schedule_never_starves(horizon: int, invoke_ticks: int, delay: int) -> None:
    found = Feasibility(horizon=horizon, invoke_ticks=invoke_ticks, delay_ticks=delay)
    assert not found.is_feasible or starved_by_simulation(horizon, invoke_ticks, delay) == 0


def realtime(**changes: Any) -> Schedule:
    """The paper's horizon and periods, with the clock running and POUNCE measured."""
    values = {"mode": Mode.REALTIME, "invoke_delay": schedules.MEASURED} | changes
    return dataclasses.replace(schedules.paper(), **values)


def test_the_papers_setting_is_feasible_in_lockstep() -> None:
    found = check_feasible(schedules.paper(), 142 * MS)
    assert (found.is_feasible, found.delay_ticks, found.ways_out) == (True, 0, ())


@pytest.mark.parametrize(("p99_ms", "d"), [(25, 1), (50, 1), (51, 2), (142, 3), (500, 10)])
def test_the_papers_setting_starves_d_ticks_per_chunk_in_real_time(p99_ms: int, d: int) -> None:
    found = check_feasible(realtime(), p99_ms * MS)
    assert (found.is_feasible, found.delay_ticks, found.starved_ticks) == (False, d, d)


@pytest.mark.parametrize("p99_ms", [0, 25, 142, 500])
def test_our_real_time_schedule_is_feasible(p99_ms: int) -> None:
    assert check_feasible(schedules.realtime(), p99_ms * MS).is_feasible


@pytest.mark.parametrize(
    ("schedule", "p99_ms", "expected"),
    [
        (realtime(), 120, 3),
        (realtime(), 0, 0),
        (dataclasses.replace(realtime(), mode=Mode.LOCKSTEP), 120, 0),  # the world waits
        (realtime(invoke_delay=Delay(kind=DelayKind.FIXED, mean_ns=100 * MS)), 900, 2),
        (dataclasses.replace(schedules.paper(), invoke_delay=schedules.FIXED_300_MS), 0, 6),
        (realtime(control_hz=30), 100, 3),
    ],
)
def test_a_delay_is_counted_in_whole_ticks(schedule: Schedule, p99_ms: int, expected: int) -> None:
    assert delay_ticks(schedule, p99_ms * MS) == expected


def test_the_sentence_names_the_way_out() -> None:
    sentence = check_feasible(realtime(), 120 * MS).sentence()
    assert sentence.startswith("d <= s <= H - d with d=3 s=20 H=20: fails, 3 starved tick(s) per chunk.")
    assert "--invoke-every-ticks 17" in sentence
    assert "--allow-starved" in sentence


def test_the_way_out_leads_out() -> None:
    assert check_feasible(realtime(invoke_period_ticks=17), 120 * MS).is_feasible


def test_a_model_too_slow_for_its_horizon_is_told_so() -> None:
    sentence = check_feasible(realtime(), 600 * MS).sentence()
    assert "A chunk of 20 rows cannot bridge 24 ticks of delay: use a longer horizon or a faster model." in sentence


def test_a_feasible_sentence_is_short() -> None:
    assert check_feasible(schedules.realtime(), 100 * MS).sentence() == "d <= s <= H - d with d=2 s=10 H=20: holds."
