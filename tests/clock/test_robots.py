"""Six axes at 30 Hz, two arms at 50 Hz, an arm on a base at 15 Hz: whatever dies, each stops as its file says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from clock.check import disagreements
from clock.check_robot import check_robot
from clock.commander import NO_ROW, Commander
from clock.dimensions import absolute, dimensions_of
from clock.limits import Hit
from clock.obeyed import Obeyed
from clock.playback import Chunk
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.robot_file import read_robot

FOLDER = Path(__file__).parents[2] / "examples/robots"
PLAYS = (m.Level.PLAY, m.Level.STALE)
ROUNDING = 1e-4


def robot_of(name: str) -> m.Robot:
    found = read_robot(FOLDER / f"{name}.toml")
    middle = (found.robot.state_low + found.robot.state_high) / 2
    return found.describe(middle.astype(np.float32), (48, 64))


NAMES = ("six_axes", "so101", "two_arms", "arm_on_base", "panda_omron")
ROBOTS = {name: robot_of(name) for name in NAMES}
BASE = ROBOTS["arm_on_base"]

TICKS = st.lists(
    st.fixed_dictionaries(
        {
            "row": st.sampled_from(["none", "near", "far", "nan"]),
            "moved": st.floats(-0.3, 0.3),
            "says": st.sampled_from([m.RobotState.OK] * 8 + [m.RobotState.USER_STOP]),
            "sight": st.sampled_from([Hit.NONE] * 5 + [Hit.PICTURE_OLD, Hit.PICTURES_APART, Hit.PICTURE_STILL]),
            "skipped": st.sampled_from([0] * 9 + [1, 3]),
            "engages": st.sampled_from([False] * 9 + [True]),
        }
    ),
    max_size=50,
)


@pytest.fixture
def timing_of(timing: Callable[..., m.Schedule]) -> Callable[..., m.Schedule]:
    """The tests' short schedule at a robot's rate."""

    def make(robot: m.Robot, **changes: Any) -> m.Schedule:
        return timing(control_hz=robot.control_hz, **changes)

    return make


@pytest.mark.parametrize("name", NAMES)
@given(ticks=TICKS, seed=st.integers(0, 2**32 - 1))
def test_whatever_dies_a_robot_stops_as_its_file_says(
    name: str, ticks: list[dict[str, Any]], seed: int, info_of: Callable[..., m.EpisodeInfo]
) -> None:
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    dims, schedule = dimensions_of(robot), schedules.realtime(robot.control_hz, 16)
    commander, obeyed = Commander(replace(info_of(schedule), robot=robot)), Obeyed(robot, robot.control_hz)
    middle, tick, since_row = (robot.state_low + robot.state_high) / 2, 0, 0
    for at in ticks:
        if at["skipped"]:
            commander.skip(at["skipped"])
            tick, since_row = tick + at["skipped"], since_row + at["skipped"]
        if at["engages"]:
            commander.engage()
        before = commander.last_command
        state = np.clip(middle + at["moved"], robot.state_low, robot.state_high).astype(np.float32)
        row, chunk = NO_ROW, None
        if at["row"] != "none":
            spread = {"near": 0.1, "far": 50.0, "nan": np.nan}[at["row"]]
            row = (before + spread * rng.uniform(-1, 1, robot.action_dim)).astype(np.float32)
            chunk = Chunk(invocation=tick, t_row0=tick, rows_NA=row[None], ref_query=0, age_ns=0)
        decided = commander.step(row, chunk, state, at["says"], sight=at["sight"])
        command, is_row = decided.command, decided.level in PLAYS
        since_row = 0 if is_row else since_row + 1
        action = m.Action(tick=tick, deadline_ns=0, level=decided.level, values=command)
        assert ((robot.command_low <= command) & (command <= robot.command_high)).all()
        assert obeyed.why_not(action, state) == "", "the robot's side holds it to the same steps"
        obeyed.obey(action)
        if not is_row:
            np.testing.assert_array_equal(command[dims.is_gripper_A], before[dims.is_gripper_A])
        if since_row >= robot.stop_ticks:
            assert not command[dims.velocities].any()
        if decided.level == m.Level.HOLD and not at["engages"]:
            np.testing.assert_array_equal(np.delete(command, dims.velocities), np.delete(before, dims.velocities))
        if at["sight"]:
            assert not is_row, "nothing new is played on pictures that are no ground to move on"
        tick += 1


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_at_its_own_rate_agrees_and_plays(name: str, timing_of: Any, lockstep: Any, tmp_path: Path) -> None:
    robot = ROBOTS[name]
    record = saved(lockstep(timing_of(robot), 60, seed=3, robot=robot, has_images=True), tmp_path)
    assert list(disagreements(record)) == []
    assert sum(tick.level in PLAYS for tick in record.ticks) > 40
    assert record.ticks[7].deadline_ns - record.ticks[0].deadline_ns == -(-7 * 10**9 // robot.control_hz)
    assert {len(tick.picture_age_ns) for tick in record.ticks} == {len(robot.cameras)}


@pytest.mark.parametrize("name", NAMES)
def test_a_server_that_falls_silent_stops_it_and_the_log_agrees(
    name: str, timing_of: Any, realtime: Any, tmp_path: Path
) -> None:
    robot = ROBOTS[name]
    delay = m.Delay(kind=m.DelayKind.MEASURED)
    timed = timing_of(robot, query_delay=delay, invoke_delay=delay, invoke_period_ticks=4, horizon=16)
    record = saved(realtime(timed, 100, seed=5, stalls=0.02, silence=range(6, 10), robot=robot), tmp_path)
    assert list(disagreements(record)) == []
    assert {m.Level.PLAY, m.Level.HOLD} <= {tick.level for tick in record.ticks}


@pytest.mark.parametrize("name", NAMES)
def test_frozen_cameras_hold_and_then_stop_it(name: str, timing_of: Any, lockstep: Any, tmp_path: Path) -> None:
    robot, frozen = ROBOTS[name], 20
    record = saved(lockstep(timing_of(robot), 90, seed=3, robot=robot, has_images=True, frozen_from=frozen), tmp_path)
    assert list(disagreements(record)) == []
    last = frozen + robot.max_picture_age_ns * robot.control_hz // 10**9
    assert record.ticks[frozen].level in PLAYS
    assert not any(tick.level in PLAYS for tick in record.ticks[last + 1 :])
    assert record.ticks[-1].level == m.Level.STOPPED
    alarms = [event for event in record.events if event.name == "pictures_unfit"]
    assert alarms[0].text.startswith("pictures are too old: ")


def test_a_velocity_that_is_left_on_is_found_though_the_rules_would_agree(
    timing_of: Any, lockstep: Any, tmp_path: Path
) -> None:
    record = saved(lockstep(timing_of(BASE), 90, seed=3, robot=BASE, has_images=True, frozen_from=20), tmp_path)
    last = record.ticks[-1]
    left_on = replace(last, action=last.action + np.eye(BASE.action_dim, dtype=np.float32)[0] * 0.1)
    found = list(check_robot(replace(record, ticks=[*record.ticks[:-1], left_on])))
    assert [(each.field, each.index) for each in found] == [("velocities", last.tick)]


def test_increments_are_summed_up_from_the_state_of_the_observation() -> None:
    state = state_in(BASE)
    rows = np.zeros((3, BASE.action_dim), np.float32)
    rows[:, 2], rows[:, 0] = [0.1, 0.2, -0.1], 0.5
    played = absolute(rows, state, BASE)
    np.testing.assert_allclose(played[:, 2], state[0] + np.array([0.1, 0.3, 0.2]), atol=1e-6)
    assert (played[:, 0] == 0.5).all(), "a velocity is none"
    assert np.isnan(absolute(rows, state[:3], BASE)[:, 2]).all()


def test_the_robot_s_side_lets_velocities_end_when_no_command_comes() -> None:
    obeyed = Obeyed(BASE, BASE.control_hz)
    values = BASE.initial_command.copy()
    values[0] = 0.15
    obeyed.obey(m.Action(tick=0, deadline_ns=0, level=m.Level.PLAY, values=values))
    speeds = [float(obeyed.idle(ticks)[0]) for ticks in range(BASE.stop_ticks + 3)]
    assert speeds == pytest.approx([0.15, 0.12, 0.09, 0.06, 0.03, 0, 0, 0])
    np.testing.assert_array_equal(obeyed.idle(9)[1:], values[1:])


def test_a_command_further_than_a_step_is_refused_by_the_robot_s_side() -> None:
    robot = ROBOTS["six_axes"]
    obeyed, values = Obeyed(robot, robot.control_hz), robot.initial_command.copy()
    values[1] += 2 * robot.max_step[1]
    state = state_in(robot)
    far = m.Action(tick=0, deadline_ns=0, level=m.Level.PLAY, values=values)
    assert "in dimension 1" in obeyed.why_not(far, state)
    assert obeyed.why_not(replace(far, tick=1), state) == "", "two ticks are two steps"
    state[1] = values[1]
    assert obeyed.why_not(far, state) == "", "a hand has moved the stopped arm there"


def state_in(robot: m.Robot) -> m.Floats:
    return ((robot.state_low + robot.state_high) / 2).astype(np.float32)


def saved(episode: Any, folder: Path) -> EpisodeRecord:
    return read_log(episode.save(folder / "episode.mcap"))
