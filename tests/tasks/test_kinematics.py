"""Forward and inverse kinematics agree with each other and with the recorded robot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dual_system.tasks import panda
from dual_system.tasks.geometry import rotation_log, screw_log
from dual_system.tasks.kinematics import Kinematics, UnreachableError
from dual_system.tasks.physics import Physics
from dual_system.tasks.scene import table_scene


@pytest.fixture(scope="module")
def arm() -> Kinematics:
    return Kinematics(Physics(table_scene()).model)


near_home = hnp.arrays(np.float64, 7, elements=st.floats(-0.3, 0.3)).map(lambda offset: panda.HOME_QPOS + offset)


@settings(max_examples=50, deadline=None)
@given(near_home)
def test_solving_for_a_reached_pose_reaches_it(arm: Kinematics, qpos: np.ndarray) -> None:
    target = arm.tcp(qpos)
    solved = arm.tcp(arm.solve(target, panda.HOME_QPOS))
    assert np.abs(solved[:3, 3] - target[:3, 3]).max() < 1e-4
    assert np.abs(rotation_log(solved[:3, :3] @ target[:3, :3].T)).max() < 1e-3


@settings(max_examples=30, deadline=None)
@given(near_home, st.integers(0, 6))
def test_jacobian_is_the_derivative_of_forward_kinematics(arm: Kinematics, qpos: np.ndarray, joint: int) -> None:
    nudge = np.zeros(7)
    nudge[joint] = 1e-6
    before, after = arm.tcp(qpos - nudge), arm.tcp(qpos + nudge)
    column = arm.jacobian(qpos)[:, joint]
    np.testing.assert_allclose((after - before)[:3, 3] / 2e-6, column[:3], atol=1e-6)
    np.testing.assert_allclose(rotation_log(after[:3, :3] @ before[:3, :3].T) / 2e-6, column[3:], atol=1e-5)


def test_home_tool_pose_is_upstreams(arm: Kinematics, recording: dict[str, Any]) -> None:
    tcp = arm.tcp(panda.HOME_QPOS)
    np.testing.assert_allclose(tcp[:3, 3], recording["home_tcp_m"], atol=1e-4)
    np.testing.assert_allclose(tcp[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-9)


def test_recorded_joints_give_the_recorded_tool_positions(arm: Kinematics, recording: dict[str, Any]) -> None:
    position_at = {entry["step"]: entry["position_m"] for entry in recording["tcp"]}
    both = [
        (entry["state"], position_at[entry["step"]]) for entry in recording["states"] if entry["step"] in position_at
    ]
    assert len(both) > 10
    for state, position_m in both:
        np.testing.assert_allclose(arm.tcp(np.array(state[:7]))[:3, 3], position_m, atol=2e-5)


def test_a_screw_path_stays_on_its_screw(arm: Kinematics) -> None:
    start, target = panda.HOME_QPOS, arm.tcp(panda.HOME_QPOS + 0.2)
    path = arm.screw_path(start, target, 11)
    whole = screw_log(np.linalg.inv(arm.tcp(start)) @ target)
    middle = screw_log(np.linalg.inv(arm.tcp(start)) @ arm.tcp(path[5]))
    np.testing.assert_allclose(middle, whole / 2, atol=1e-3)
    np.testing.assert_allclose(path[0], start)


def test_a_point_out_of_reach_is_refused(arm: Kinematics) -> None:
    far = arm.tcp(panda.HOME_QPOS)
    far[0, 3] += 2.0
    with pytest.raises(UnreachableError, match="cannot reach"):
        arm.solve(far, panda.HOME_QPOS)


def test_a_joint_beyond_its_limit_is_refused(arm: Kinematics) -> None:
    turned = panda.HOME_QPOS.copy()
    turned[6] = panda.JOINT_HIGH_RAD[6] + 0.2
    with pytest.raises(UnreachableError, match=r"turns joint 7 to 3\.\d+ rad"):
        arm.solve(arm.tcp(turned), turned)


@given(yaw_rad=st.floats(-2.3, -2.17))
@settings(max_examples=20, deadline=None)
def test_a_joint_can_stop_at_its_limit_while_the_others_reach(arm: Kinematics, yaw_rad: float) -> None:
    target = arm.tcp(panda.HOME_QPOS)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    target[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ target[:3, :3]
    target[:3, 3] = 0.0, 0.0, 0.2
    with pytest.raises(UnreachableError, match="turns joint 7 to"):
        arm.screw_path(panda.HOME_QPOS, target, 30)
    path = arm.screw_path(panda.HOME_QPOS, target, 30, stopping_at_limits=True)
    assert np.all(path >= panda.JOINT_LOW_RAD)
    assert np.all(path <= panda.JOINT_HIGH_RAD)
    np.testing.assert_allclose(arm.tcp(path[-1]), target, atol=2e-4)
