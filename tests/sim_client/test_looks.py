"""Pictures that nobody will ask for are not made, and nothing else changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from clock import schedules
from protocol import messages as m

STEPS = 80
MS = 1_000_000


@given(
    query_ms=st.integers(100, 3000),
    invoke_ticks=st.integers(1, 20),
    delay_ms=st.integers(0, 1500),
    pounce_ms=st.integers(0, 400),
    wait=st.sampled_from([m.WaitKind.STAND_STILL, m.WaitKind.HOLD]),
    delivery=st.sampled_from([m.DeliveryKind.EVERY, m.DeliveryKind.HELD_TRANSITION, m.DeliveryKind.NULL]),
)
@settings(max_examples=10)
def test_the_same_is_commanded_whether_every_tick_is_looked_at_or_only_those_asked_about(
    new_rig: Callable[..., Any],
    episode_info: Callable[..., m.EpisodeInfo],
    query_ms: int,
    invoke_ticks: int,
    delay_ms: int,
    pounce_ms: int,
    wait: m.WaitKind,
    delivery: m.DeliveryKind,
) -> None:
    schedule = dataclasses.replace(
        schedules.paper(),
        query_period_ns=query_ms * MS,
        invoke_period_ticks=invoke_ticks,
        query_delay=m.Delay(kind=m.DelayKind.LOG_NORMAL, mean_ns=delay_ms * MS, sigma=0.3),
        invoke_delay=m.Delay(kind=m.DelayKind.FIXED, mean_ns=pounce_ms * MS),
        delivery=m.Delivery(kind=delivery),
        wait=wait,
    )
    everything, sparing = new_rig(), new_rig()
    outcome, world = everything.run(episode_info(schedule), STEPS)
    twin_outcome, twin = sparing.run(
        episode_info(schedule), STEPS, lambda tick: sparing.clock.conductor.will_look(tick)
    )
    assert twin_outcome == outcome
    assert twin.commands == world.commands
    assert twin.num_looks <= world.num_looks == STEPS


def test_on_the_paper_s_schedule_one_tick_in_ten_is_looked_at(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    _, world = rig.run(episode_info(paper), 200, lambda tick: rig.clock.conductor.will_look(tick))
    assert world.num_looks == 20  # both models at 1 Hz, on ticks of their own
