"""Other benchmarks' actions as joint targets: poses are reached, deltas have their length, nonsense is refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.environment import make_environment
from dual_system.tasks.geometry import rotation_log
from dual_system.tasks.kinematics import Kinematics
from sim_client.action_spaces import DELTA_M, DELTA_RAD, NUM_NUMBERS, hold, reader, row_of

HOME = np.append(panda.HOME_QPOS, 0.04)


@pytest.fixture(scope="module")
def model() -> Iterator[Any]:
    with make_environment("PickHighlight", render=False) as environment:
        yield environment.physics.model


def test_joint_angles_are_taken_as_they_are(model: Any) -> None:
    action = np.linspace(-1, 1, 8)
    assert reader("joint_angle")(action, HOME, model).tolist() == action.tolist()


@pytest.mark.parametrize("gripper", [-1.0, 1.0])
def test_a_tool_pose_is_reached(model: Any, gripper: float) -> None:
    there = panda.HOME_QPOS + 0.1
    T = Kinematics(model).tcp(there)
    pitch = -np.arcsin(T[2, 0])
    angles = [np.arctan2(T[2, 1], T[2, 2]), pitch, np.arctan2(T[1, 0], T[0, 0])]
    command = reader("ee_pose")(np.array([*T[:3, 3], *angles, gripper]), HOME, model)
    assert Kinematics(model).tcp(command[:7]) == pytest.approx(T, abs=2e-4)
    assert command[7] == gripper


def test_a_delta_moves_the_tool_along_the_world_s_axes_and_turns_it_about_them(model: Any) -> None:
    here = Kinematics(model).tcp(panda.HOME_QPOS)
    read = reader("ee_delta")
    for axis in range(3):
        moved = Kinematics(model).tcp(read(np.eye(7)[axis], HOME, model)[:7])
        assert moved[:3, 3] - here[:3, 3] == pytest.approx(DELTA_M * np.eye(3)[axis], abs=1e-4)
        turned = Kinematics(model).tcp(read(0.2 * np.eye(7)[3 + axis], HOME, model)[:7])
        assert rotation_log(turned[:3, :3] @ here[:3, :3].T) == pytest.approx(
            0.2 * DELTA_RAD * np.eye(3)[axis], abs=1e-3
        )


def test_a_delta_closes_the_gripper_with_plus_one(model: Any) -> None:
    read = reader("ee_delta")
    assert [read(np.array([0, 0, 0, 0, 0, 0, value]), HOME, model)[7] for value in (1.0, -1.0)] == [-1.0, 1.0]


def test_what_cannot_be_reached_leaves_the_arm_where_it_is(model: Any) -> None:
    command = reader("ee_pose")(np.array([9.0, 0, 0, 0, 0, 0, 1.0]), HOME, model)
    assert command[:7].tolist() == HOME[:7].tolist()


@pytest.mark.parametrize("space", NUM_NUMBERS)
def test_another_robot_s_actions_are_refused_with_the_way_out(model: Any, space: Any) -> None:
    for action in (np.zeros(23), np.full(NUM_NUMBERS[space], np.nan)):
        with pytest.raises(ValueError, match="Other values of action_space"):
            reader(space)(action, HOME, model)


def test_an_unknown_space_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of joint_angle, ee_pose, ee_delta"):
        reader("joints")  # type: ignore[arg-type]


def test_an_action_is_found_under_either_name() -> None:
    for name in ("actions", "action"):
        assert row_of({name: [[1, 2]]}).tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="came 'rows'"):
        row_of({"rows": [1]})


def test_holding_moves_nothing(model: Any) -> None:
    joints = panda.HOME_QPOS
    first = hold("joint_angle", None, joints)
    assert first["actions"].tolist() == pytest.approx([*joints, 1.0])
    assert hold("joint_angle", first, joints + 1)["actions"].tolist() == first["actions"].tolist()
    delta = hold("ee_delta", {"actions": np.ones(7)}, joints)["actions"]
    assert delta.tolist() == [0, 0, 0, 0, 0, 0, 1]
    command = reader("ee_delta")(delta, HOME, model)
    assert command[:7] == pytest.approx(joints, abs=1e-6)
    with pytest.raises(ValueError, match="wait_first_action"):
        hold("ee_pose", None, joints)
