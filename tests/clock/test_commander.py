"""Whatever is planned, measured or reported, the next command is one that the robot may be given."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from clock.commander import NO_ROW, Commander, Decision, blocked_ticks
from clock.limits import Hit
from clock.playback import Chunk
from protocol.messages import EpisodeInfo, Floats, Level, Robot, RobotState, Schedule

DIM = 4
STEP, LEAD, RANGE = 0.1, 0.3, 1.1
OK, UNSAID = RobotState.OK, RobotState.UNSPECIFIED
NUMBERS = st.floats(width=32, allow_nan=False, allow_infinity=False)
STATES = hnp.arrays(np.float32, DIM, elements=NUMBERS | st.floats(-1, 1, width=32))
ROWS = st.none() | hnp.arrays(np.float32, DIM, elements=st.floats(width=32) | st.floats(-1.5, 1.5, width=32))

MakeInfo = Callable[..., EpisodeInfo]


@pytest.fixture(scope="session")
def info(timing: Callable[..., Schedule], info_of: MakeInfo) -> EpisodeInfo:
    """An arm of three joints within [-1, 1], and a gripper that may jump."""
    return dataclasses.replace(info_of(timing()), robot=robot())


def robot(**changes: Any) -> Robot:
    values: dict[str, Any] = {
        "name": "arm",
        "command_low": np.full(DIM, -1, np.float32),
        "command_high": np.full(DIM, 1, np.float32),
        "max_step": np.array([STEP] * 3 + [0], np.float32),
        "max_lead": np.array([LEAD] * 3 + [0], np.float32),
        "state_low": np.full(DIM, -RANGE, np.float32),
        "state_high": np.full(DIM, RANGE, np.float32),
        "initial_command": np.zeros(DIM, np.float32),
        "cameras": (),
        "image_height": 1,
        "image_width": 1,
        "num_proprio": DIM,
        "is_simulated": False,
    }
    return Robot(**(values | changes))


def decide(commander: Commander, row: Floats | None, state: Floats, says: RobotState = UNSAID) -> Decision:
    """One tick; each row is of a chunk of its own."""
    if row is None:
        return commander.step(NO_ROW, None, state, says)
    chunk = Chunk(invocation=0, t_row0=0, rows_NA=row[None], ref_query=0, age_ns=0)
    return commander.step(row, chunk, state, says)


def at(*joints: float) -> Floats:
    return np.array(joints, np.float32)


@given(ticks=st.lists(st.tuples(ROWS, STATES, st.sampled_from(RobotState), st.booleans()), max_size=40))
def test_every_command_is_within_the_limits_and_a_step_of_the_last(
    info: EpisodeInfo, ticks: list[tuple[Floats | None, Floats, RobotState, bool]]
) -> None:
    commander, is_engaged = Commander(info), False
    for row, state, says, engages in ticks:
        if engages:
            commander.engage()
        is_engaged = is_engaged or engages
        before = commander.last_command
        decided = decide(commander, row, state, says)
        assert (decided.command >= info.robot.command_low).all()
        assert (decided.command <= info.robot.command_high).all()
        if is_engaged and (np.abs(state) <= RANGE).all():  # from where the arm stands
            before, is_engaged = np.clip(state, -1, 1), False
        assert np.abs(decided.command - before)[:3].max() <= STEP + 1e-5


@given(rows=st.lists(hnp.arrays(np.float32, DIM, elements=st.floats(-1.5, 1.5, width=32)), max_size=40))
def test_an_arm_that_does_not_move_is_not_wound_up(info: EpisodeInfo, rows: list[Floats]) -> None:
    commander, stuck = Commander(info), np.zeros(DIM, np.float32)
    for row in rows:
        assert np.abs(decide(commander, row, stuck).command[:3]).max() <= LEAD + 1e-6


def test_a_blocked_arm_is_held_and_then_stopped_where_it_is(info: EpisodeInfo) -> None:
    commander, stuck = Commander(info), np.zeros(DIM, np.float32)
    decisions = [decide(commander, at(1, 0, 0, 1), stuck) for _ in range(60)]
    levels = list(dict.fromkeys(decided.level for decided in decisions))
    assert levels == [Level.PLAY, Level.HOLD, Level.DECELERATE, Level.STOPPED]
    at_lead = [decided for decided in decisions if decided.level == Level.PLAY and Hit.LEAD in decided.hit]
    assert len(at_lead) == blocked_ticks(info.schedule.control_hz)
    np.testing.assert_allclose(decisions[-1].command, at(0, 0, 0, 1), atol=1e-6)


def test_an_arm_that_comes_free_in_time_plays_on(info: EpisodeInfo) -> None:
    commander, stuck = Commander(info), np.zeros(DIM, np.float32)
    while decide(commander, at(1, 0, 0, 1), stuck).level == Level.PLAY:
        pass
    decided = decide(commander, at(1, 0, 0, 1), commander.last_command)
    assert decided.level == Level.PLAY
    assert not commander.blocked_ticks


@given(state=STATES)
def test_what_cannot_be_measured_is_never_acted_on(info: EpisodeInfo, state: Floats) -> None:
    commander = Commander(info)
    played = decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0)).command
    decided = decide(commander, at(0.2, 0, 0, 1), state)
    if (np.abs(state) <= RANGE).all():
        assert Hit.STATE not in decided.hit
    else:
        assert (decided.level, Hit.STATE in decided.hit) == (Level.HOLD, True)
        np.testing.assert_array_equal(decided.command, played)


def test_a_state_in_degrees_ends_in_a_stop_without_motion(info: EpisodeInfo) -> None:
    commander = Commander(info)
    played = decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0)).command
    decisions = [decide(commander, at(0.2, 0, 0, 1), at(45, 0, 0, 0)) for _ in range(30)]
    assert decisions[-1].level == Level.STOPPED
    assert all((decided.command == played).all() for decided in decisions)


@pytest.mark.parametrize("says", [state for state in RobotState if not state.obeys])
def test_a_robot_that_does_not_obey_is_stopped_in_the_same_tick_and_latched(
    info: EpisodeInfo, says: RobotState
) -> None:
    commander = Commander(info)
    assert decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0), OK).level == Level.PLAY
    assert decide(commander, at(0.2, 0, 0, 1), at(0.1, 0, 0, 0), says).level == Level.STOPPED
    assert decide(commander, at(0.2, 0, 0, 1), at(0.1, 0, 0, 0), OK).level == Level.STOPPED
    commander.engage()
    assert decide(commander, at(0.2, 0, 0, 1), at(0.1, 0, 0, 0), OK).level == Level.PLAY


@given(moved=hnp.arrays(np.float32, 3, elements=st.floats(-0.875, 0.875, width=32)), num_ticks=st.integers(0, 30))
def test_an_arm_that_was_moved_by_hand_does_not_snap_back(info: EpisodeInfo, moved: Floats, num_ticks: int) -> None:
    """Stopped, pushed elsewhere, released, engaged: every command is at most a step from where the arm is."""
    commander = Commander(info)
    decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0))
    decide(commander, None, at(0.1, 0, 0, 0), RobotState.USER_STOP)
    elsewhere = np.append(moved, 0).astype(np.float32)
    for _ in range(num_ticks):
        before = commander.last_command
        followed = decide(commander, None, elsewhere, OK)
        assert followed.level == Level.STOPPED
        assert np.abs(followed.command - before)[:3].max() <= STEP + 1e-6
    if num_ticks >= 10:
        assert np.abs(commander.last_command - elsewhere)[:3].max() <= STEP + 1e-6
    commander.engage()
    arm = elsewhere
    for _ in range(20):
        command = decide(commander, at(0.1, 0, 0, 1), arm, OK).command
        assert np.abs(command - arm)[:3].max() <= STEP + 1e-6
        arm = np.append(command[:3], 0).astype(np.float32)


def test_a_stopped_arm_at_rest_is_left_alone(info: EpisodeInfo) -> None:
    """Servos with a proportional gain only would sag if they were commanded to where they were measured."""
    commander = Commander(info)
    held = decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0)).command
    for sag in (0.02, 0.04, 0.06):
        stopped = decide(commander, None, held - at(sag, sag, sag, 0), RobotState.USER_STOP)
        np.testing.assert_array_equal(stopped.command, held)


def test_the_gripper_stays_as_it_is_whatever_stops(info: EpisodeInfo) -> None:
    commander = Commander(info)
    decide(commander, at(0.1, 0, 0, 1), at(0, 0, 0, 0))
    commands = [decide(commander, None, at(0, 0, 0, -1), OK).command for _ in range(40)]
    assert {command[3] for command in commands} == {1}
