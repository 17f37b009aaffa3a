"""The arm in numpy is the scene's arm: the same poses, derivative and limits as MuJoCo's, and the way back."""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # before anything imports mujoco

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dual_system.models import arm
from dual_system.tasks import panda
from dual_system.tasks.geometry import rotation_log
from dual_system.tasks.kinematics import Kinematics
from dual_system.tasks.panda_model import panda_spec

within_limits = arrays(np.float64, 7, elements=st.floats(0, 1)).map(
    lambda share: arm.JOINT_LOW_RAD + share * (arm.JOINT_HIGH_RAD - arm.JOINT_LOW_RAD)
)
near_home = arrays(np.float64, 7, elements=st.floats(-0.4, 0.4)).map(lambda offset: panda.HOME_QPOS + offset)
nudges = arrays(np.float64, 7, elements=st.floats(-0.05, 0.05))
vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))


@pytest.fixture(scope="module")
def mujoco_arm() -> Kinematics:
    return Kinematics(panda_spec().compile())


@settings(deadline=None, max_examples=100)
@given(joints=within_limits)
def test_poses_and_derivatives_are_mujocos(mujoco_arm: Kinematics, joints: np.ndarray) -> None:
    T, tool = mujoco_arm.tcp(joints), arm.tool_poses(joints)
    assert np.abs(tool.position_m - T[:3, 3]).max() < 1e-6
    assert np.linalg.norm(rotation_log(tool.rotation @ T[:3, :3].T)) < 1e-6
    np.testing.assert_allclose(arm.tool_jacobian(joints), mujoco_arm.jacobian(joints), atol=1e-9)


def test_limits_are_the_scenes() -> None:
    np.testing.assert_array_equal(arm.JOINT_LOW_RAD, panda.JOINT_LOW_RAD)
    np.testing.assert_array_equal(arm.JOINT_HIGH_RAD, panda.JOINT_HIGH_RAD)


@given(joints=arrays(np.float64, (3, 2, 7), elements=st.floats(-3, 3)))
@settings(deadline=None, max_examples=10)
def test_many_rows_are_each_row_alone(joints: np.ndarray) -> None:
    together = arm.tool_poses(joints)
    for place in np.ndindex(3, 2):
        alone = arm.tool_poses(joints[place])
        np.testing.assert_allclose(together.position_m[place], alone.position_m, atol=1e-12)
        np.testing.assert_allclose(together.rotation[place], alone.rotation, atol=1e-12)


@settings(deadline=None, max_examples=60)
@given(joints=near_home, nudge=nudges)
def test_a_reached_pose_is_reached_again_from_nearby(joints: np.ndarray, nudge: np.ndarray) -> None:
    target = arm.tool_poses(joints)
    solved = arm.joints_near(target, joints + nudge)
    came = arm.tool_poses(solved)
    assert np.abs(came.position_m - target.position_m).max() < 1e-5
    assert np.linalg.norm(arm.rotation_vectors(came.rotation @ target.rotation.T)) < 2e-4
    assert (
        np.linalg.norm(solved - (joints + nudge)) < 1.5 * np.linalg.norm(nudge) + 1e-3
    )  # the shortest way, not around


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("turn_rad", [-0.02, 0.02])
def test_with_a_joint_at_its_limit_the_others_reach(joint: int, turn_rad: float) -> None:
    start = panda.HOME_QPOS + 0.1
    start[6] = arm.JOINT_HIGH_RAD[6]
    there = start.copy()
    there[joint] += turn_rad
    target = arm.tool_poses(there)
    solved = arm.joints_near(target, start)
    assert solved[6] <= arm.JOINT_HIGH_RAD[6]
    np.testing.assert_allclose(arm.tool_poses(solved).position_m, target.position_m, atol=1e-4)
    np.testing.assert_allclose(arm.tool_poses(solved).rotation, target.rotation, atol=1e-3)


def test_a_turn_beyond_the_limit_does_not_cost_the_place() -> None:
    start = panda.HOME_QPOS.copy()
    start[6] = arm.JOINT_HIGH_RAD[6]
    here = arm.tool_poses(start)
    beyond = arm.Poses(here.position_m, arm.rotations(np.array([0.0, 0.0, -0.3])) @ here.rotation)
    solved = arm.joints_near(beyond, start)
    assert solved[6] <= arm.JOINT_HIGH_RAD[6]
    np.testing.assert_allclose(arm.tool_poses(solved).position_m, here.position_m, atol=1e-3)


@given(vector=vectors)
@settings(deadline=None)
def test_rotation_vectors_there_and_back(vector: np.ndarray) -> None:
    np.testing.assert_allclose(arm.rotation_vectors(arm.rotations(vector)), vector, atol=1e-9)


def test_half_a_turn_keeps_its_axis() -> None:
    for axis in np.eye(3):
        assert np.abs(arm.rotation_vectors(arm.rotations(np.pi * axis))) == pytest.approx(np.pi * axis, abs=1e-7)
