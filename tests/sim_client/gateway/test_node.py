"""An episode between a client that asks and a clock that commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from dual_system.models.ponder.demo_sampling import DemoSampling
from protocol import messages as m
from sim_client.gateway.node import LiveNode, LockstepNode, Measurement
from sim_client.gateway.rule import ahead, sampled
from sim_client.robot_end import STOPPED_S

TICK_NS = 50_000_000
START_NS = 300_000_000
SHOWN = Measurement((), np.zeros(3, np.float32))
LIMIT = np.full(3, 9, np.float32)
ROBOT = m.Robot(
    name="arm", command_low=-LIMIT, command_high=LIMIT, max_step=LIMIT, initial_command=0 * LIMIT, cameras=(),
    image_height=1, image_width=1, num_proprio=3, is_simulated=True,
)  # fmt: skip
STOPPED_TICKS = STOPPED_S * schedules.CONTROL_HZ


def commanded(tick: int, level: m.Level = m.Level.PLAY) -> m.Action:
    values = np.full(3, 0.01 * tick, np.float32)
    return m.Action(tick=tick, deadline_ns=START_NS + tick * TICK_NS, level=level, values=values)


def chunk_from(tick: int, invocation: int = 0, value: float = 0.0) -> m.ActionChunk:
    rows = np.full((20, 3), value, np.float32)
    return m.ActionChunk(
        invocation=invocation, t_row0=tick, horizon=20, action_dim=3, dt_ns=TICK_NS, rows=rows.ravel(), source_ns=0,
        ref_query=None, age_ns=0,
    )  # fmt: skip


@pytest.fixture
def info(episode_info: Callable[..., m.EpisodeInfo]) -> m.EpisodeInfo:
    return episode_info(schedules.paper())


def account_of(action: m.Action, invocation: int | None) -> m.Tick:
    return m.Tick(tick=action.tick, deadline_ns=0, decided_ns=0, late_ns=0, level=action.level, invocation=invocation)


@given(num_rows=st.integers(1, 20), num_requests=st.integers(1, 4), tells=st.booleans())
def test_every_tick_is_shown_once_in_order_and_at_its_instant(num_rows: int, num_requests: int, tells: bool) -> None:
    node = LockstepNode(_info(), num_rows)
    published: list[m.Observation] = []
    for request in range(num_requests):
        first = request * num_rows
        since = [shown_at(tick) for tick in range(first - num_rows + 1, first)] if tells and request else []
        observation: m.Observation | None = node.show(since, shown_at(first))
        while observation is not None:
            assert node.answer() is None
            published.append(observation)
            observation = node.on_action(commanded(observation.tick))
        if num_rows == 1:
            answer = node.answer()
            assert answer is not None
            assert (answer.tick, answer.rows_NA.tolist()) == (first, [commanded(first).values.tolist()])
    ticks = list(range(num_rows * (num_requests - 1) + 1))
    assert [observation.tick for observation in published] == ticks
    assert [o.source_ns for o in published] == [0, *(START_NS + tick * TICK_NS for tick in ticks[1:])]
    seen = ticks if tells else [tick // num_rows * num_rows for tick in ticks]
    assert [int(observation.proprio[0]) for observation in published] == seen


def shown_at(tick: int) -> Measurement:
    return Measurement((), np.full(3, tick, np.float32))


def _info() -> m.EpisodeInfo:
    """Hypothesis runs outside of fixtures: what a lockstep node reads of it."""
    return m.EpisodeInfo(
        task="", suite="", seed=0, difficulty="", instruction="", schedule=schedules.paper(),
        robot=ROBOT, t0_unix_ns=0,
    )  # fmt: skip


def test_commands_of_other_ticks_change_nothing(info: m.EpisodeInfo) -> None:
    node = LockstepNode(info, 1)
    assert node.on_action(commanded(0)) is None  # nothing was asked
    node.show([], SHOWN)
    for tick in (1, 5):
        assert node.on_action(commanded(tick)) is None
    assert node.answer() is None
    node.on_action(commanded(0))
    assert node.answer() is not None


def test_a_promise_waits_for_the_chunk_that_the_command_came_from(info: m.EpisodeInfo) -> None:
    node = LockstepNode(info, 3)
    node.show([], SHOWN)
    node.on_action(commanded(0))
    assert node.answer() is None
    node.commands.on_account(account_of(commanded(0), invocation=7))
    node.commands.on_chunk(chunk_from(0, invocation=6, value=0.09))
    assert node.answer() is None
    node.commands.on_chunk(chunk_from(0, invocation=7, value=0.05))
    answer = node.answer()
    assert answer is not None
    assert answer.rows_NA[:, 0].tolist() == pytest.approx([0.0, 0.05, 0.05])


def test_a_held_command_needs_no_chunk(info: m.EpisodeInfo) -> None:
    node = LockstepNode(info, 3)
    node.show([], SHOWN)
    held = commanded(0, m.Level.HOLD)
    node.on_action(held)
    node.commands.on_account(account_of(held, invocation=None))
    answer = node.answer()
    assert answer is not None
    assert answer.levels == (m.Level.HOLD,) * 3


def test_live_a_request_is_answered_with_the_newest_command(info: m.EpisodeInfo) -> None:
    node = LiveNode(info, 1)
    assert node.answer(0) is None
    assert (node.show(SHOWN, 7).tick, node.show(SHOWN, 7).source_ns) == (0, 7)
    for tick in (0, 1, 4, 2):  # the fourth comes late
        node.on_action(commanded(tick), 0)
    answer = node.answer(0)
    assert answer is not None
    assert (answer.tick, answer.levels) == (4, (m.Level.PLAY,))
    assert answer.rows_NA.tolist() == [commanded(4).values.tolist()]
    assert node.show(SHOWN, 9).tick == 5


def test_live_several_rows_are_the_command_and_what_its_chunk_has_ahead(info: m.EpisodeInfo) -> None:
    node = LiveNode(info, 4)
    node.commands.on_chunk(chunk_from(0, value=0.05))
    node.on_action(commanded(18), 0)
    node.commands.on_account(account_of(commanded(18), invocation=0))
    answer = node.answer(0)
    assert answer is not None
    assert answer.levels == (m.Level.PLAY, m.Level.PLAY, m.Level.HOLD, m.Level.HOLD)
    assert answer.rows_NA[:, 0].tolist() == pytest.approx([commanded(18).values[0], 0.05, 0.05, 0.05], abs=1e-6)


def test_live_an_answer_comes_after_a_tick_and_with_its_deadline_on_the_host_s_clock(info: m.EpisodeInfo) -> None:
    node = LiveNode(info, 1)
    for tick, late_ns in ((3, 900), (4, 200), (5, 500)):  # what is least late shows where episode time began
        action = replace(commanded(tick), deadline_ns=1000 * tick, header=m.Header(at_ns=1000 * tick))
        node.on_action(action, 70_000 + 1000 * tick + late_ns)
    assert node.answer(0, 5) is None
    answer = node.answer(0, 4)
    assert answer is not None
    assert (answer.tick, answer.deadline_ns) == (5, 75_200)


def test_live_an_arm_that_stays_stopped_ends_the_episode(info: m.EpisodeInfo) -> None:
    node = LiveNode(info, 1)
    for tick in range(STOPPED_TICKS):
        node.on_action(commanded(tick, m.Level.STOPPED), 0)
    assert not node.is_over
    node.on_action(commanded(STOPPED_TICKS, m.Level.STOPPED), 0)
    assert node.is_over
    assert not replace(node, waits_for_person=True).is_over


@pytest.mark.parametrize("level", [m.Level.HOLD, m.Level.DECELERATE, m.Level.STOPPED])
def test_a_robot_that_does_not_play_is_promised_no_rows_of_a_chunk(
    robot_with: Callable[..., m.Robot], level: m.Level
) -> None:
    rows, levels = ahead(commanded(3, level), chunk_from(0), robot_with(), 5)
    assert (rows == commanded(3).values).all()
    assert set(levels) == {level}


def test_rows_ahead_obey_the_limits(robot_with: Callable[..., m.Robot]) -> None:
    robot = robot_with()
    rows, _ = ahead(commanded(0), chunk_from(0, value=9.0), robot, 20)
    assert np.abs(np.diff(rows, axis=0)).max() <= robot.max_step[0] + 1e-6
    assert rows.max() <= robot.command_high[0]


@pytest.mark.parametrize(("num_frames", "read"), [(0, []), (1, [0]), (20, [0]), (21, [0, 20]), (45, [0, 20, 40])])
def test_of_a_video_ponder_reads_the_first_frame_and_one_a_second(num_frames: int, read: list[int]) -> None:
    video: Any = list(range(num_frames))
    assert list(sampled(video, 20, DemoSampling())) == read


@pytest.mark.parametrize(
    ("num_frames", "read"), [(0, []), (1, [0]), (10, [0, 9]), (11, [0, 10]), (12, [0, 10, 11]), (21, [0, 10, 20])]
)
def test_of_a_video_that_is_shown_twice_a_second_and_to_its_end_ponder_reads_the_last_frame_too(
    num_frames: int, read: list[int]
) -> None:
    video: Any = list(range(num_frames))
    assert list(sampled(video, 20, DemoSampling(hz=2, to_its_end=True))) == read
