"""The Panda with a stick: what it says of itself, what its actions mean, how it is described, and what it can do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.tasks import panda, predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.panda import PANDA_STICK, PANDA_WRISTCAM, Robot
from dual_system.tasks.physics import Physics
from dual_system.tasks.props import add_block, add_dot
from dual_system.tasks.scene import table_scene
from sim_client.panda_robot import simulated_robot

HOME = np.append(panda.HOME_QPOS, -1.0)
ROBOTS = (PANDA_WRISTCAM, PANDA_STICK)


@pytest.fixture(scope="module")
def one_table() -> Physics:
    spec = table_scene(PANDA_STICK)
    add_block(spec, "post", (0.03, 0.015, 0.05))
    add_dot(spec, "goal", 0.005)
    return Physics(spec)


@pytest.fixture
def table(one_table: Physics) -> Physics:
    """The stick robot at home, a post and a mark, both away."""
    one_table.reset()
    return one_table


@pytest.fixture(scope="module", params=["pattern_lock", "route_stick"])
def recording(request: pytest.FixtureRequest) -> dict[str, Any]:
    path = Path(__file__).parent / "data" / f"{request.param}_train006.json"
    facts: dict[str, Any] = json.loads(path.read_text())
    return facts


def played(table: Physics, actions: Actions) -> list[np.ndarray]:
    """Plays actions; returns them."""
    done = []
    for action in actions:
        table.advance(action.astype(np.float64))
        done.append(action)
    return done


def put_goal(table: Physics, x_m: float, y_m: float) -> None:
    table.place("goal", pose(x_m, y_m, 0.01))
    table.refresh()


def tip_m(table: Physics) -> np.ndarray:
    return table.tcp_transform()[:3, 3]


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_a_scene_says_which_robot_stands_in_it(robot: Robot) -> None:
    world = Physics(table_scene(robot))
    assert world.robot is robot
    assert world.state().shape == (8,)
    assert np.all((robot.state_low <= world.state()) & (world.state() <= robot.state_high))
    assert np.all(robot.action_low <= robot.action_high)


def test_at_home_it_says_and_stands_as_recorded(table: Physics, recording: dict[str, Any]) -> None:
    np.testing.assert_allclose(table.state(), recording["home_state"], atol=1e-4)
    np.testing.assert_allclose(tip_m(table), recording["home_tcp_m"], atol=1e-4)


def test_its_state_ends_with_0_and_its_command_with_minus_1(table: Physics) -> None:
    assert table.state()[7] == 0.0
    assert table.gripper_command() == -1.0
    assert table.finger_openings_m().shape == (0,)
    assert not table.is_grasped("post")


@settings(max_examples=10, deadline=None)
@given(st.floats(-1, 1))
def test_the_last_entry_of_an_action_moves_nothing(one_table: Physics, last: float) -> None:
    def ends_at(entry: float) -> bytes:
        one_table.reset()
        one_table.advance(np.append(panda.HOME_QPOS + 0.1, entry))
        return one_table.data.qpos.tobytes()

    assert ends_at(last) == ends_at(-1.0)


@pytest.mark.parametrize(("robot", "last", "low", "high"), [(PANDA_WRISTCAM, 1, -1, 1), (PANDA_STICK, -1, -1, -1)])
def test_the_protocol_is_told_what_it_is(robot: Robot, last: float, low: float, high: float) -> None:
    state = np.append(panda.HOME_QPOS, 0.04)
    message = simulated_robot(robot, state)
    assert message.name == robot.name
    assert message.action_dim == message.num_proprio == 8
    np.testing.assert_allclose(message.initial_command, np.append(panda.HOME_QPOS, last), rtol=1e-6)
    assert (message.command_low[7], message.command_high[7]) == (low, high)
    np.testing.assert_allclose(message.command_high[:7], panda.JOINT_HIGH_RAD, rtol=1e-6)


def test_the_stick_stops_at_what_stands_in_its_way(table: Physics) -> None:
    put_goal(table, 0.0, -0.1)
    played(table, Motions(table).point_at("goal"))
    table.place("post", pose(0.0, 0.0, 0.05))
    put_goal(table, 0.0, 0.1)
    played(table, Motions(table).point_at("goal"))
    assert -0.03 < tip_m(table)[1] < -0.015  # the post's side is at -0.015, the stick is 16 mm thick


def test_pointing_ends_seven_centimetres_above_the_goal_and_keeps_to_its_speed(table: Physics) -> None:
    put_goal(table, 0.05, 0.15)
    actions = np.array(played(table, Motions(table).point_at("goal")))
    np.testing.assert_allclose(tip_m(table), [0.05, 0.15, 0.07], atol=1e-3)
    np.testing.assert_allclose(table.tcp_transform()[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=5e-3)
    assert np.abs(np.diff(actions[:, :7], axis=0)).max() * 20 < 0.35  # 0.3 rad/s, rounded to whole steps
    assert np.all(actions[:, 7] == -1)
    assert predicates.is_tool_over(table, "goal", within_m=0.002, below_z_m=0.075)
    assert not predicates.is_tool_over(table, "goal", within_m=0.002, below_z_m=0.065)


def test_pointing_at_once_commands_one_posture_and_gets_there(table: Physics) -> None:
    put_goal(table, -0.15, -0.05)
    actions = np.array(played(table, Motions(table).point_at_once("goal")))
    assert len(np.unique(actions, axis=0)) == 1
    np.testing.assert_allclose(tip_m(table), [-0.15, -0.05, 0.07], atol=1e-3)


def test_going_home_takes_as_long_as_it_is_told(table: Physics) -> None:
    put_goal(table, -0.15, -0.05)
    played(table, Motions(table).point_at_once("goal"))
    actions = np.array(played(table, Motions(table).go_home(40)))
    np.testing.assert_allclose(actions, np.tile(HOME, (40, 1)), atol=1e-6)
    np.testing.assert_allclose(table.state()[:7], panda.HOME_QPOS, atol=1e-3)


@pytest.mark.parametrize("bulge_m", [0.2, -0.2])
def test_a_sweep_bulges_to_its_side_and_ends_over_the_goal(table: Physics, bulge_m: float) -> None:
    put_goal(table, -0.1, -0.07)
    played(table, Motions(table).point_at("goal"))
    put_goal(table, -0.1, 0.07)  # straight to the left; left of that way is towards the robot
    way_m = []
    for action in Motions(table).sweep_to("goal", bulge_m):
        table.advance(action.astype(np.float64))
        way_m.append(tip_m(table))
    x_m, y_m, z_m = np.array(way_m).T
    assert len(way_m) == 50
    assert np.all(np.abs(z_m - 0.07) < 2e-3)
    outermost_m = np.abs(x_m + 0.1).max()
    assert outermost_m == pytest.approx(0.1, abs=5e-3)  # a parabola comes half as far as its control point
    assert np.sign(x_m[np.abs(x_m + 0.1).argmax()] + 0.1) == -np.sign(bulge_m)
    np.testing.assert_allclose([x_m[-1], y_m[-1]], [-0.1, 0.07], atol=2e-3)


def test_a_sweep_out_of_reach_is_refused_before_it_begins(table: Physics) -> None:
    put_goal(table, 1.5, 0.0)
    with pytest.raises(UnreachableError):
        next(Motions(table).sweep_to("goal", 0.2))
