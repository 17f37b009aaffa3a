"""The arm's model: limits, commands, and lighter meshes of the same shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dual_system.tasks import panda
from dual_system.tasks.panda_model import cluster
from dual_system.tasks.physics import Physics


@given(hnp.arrays(np.float64, (30, 3), elements=st.floats(-0.1, 0.1)))
def test_clustering_moves_no_vertex_farther_than_a_cell(vertices: np.ndarray) -> None:
    faces = np.arange(30, dtype=np.int32).reshape(10, 3)
    merged, _ = cluster(vertices, faces, cell_m=0.01)
    distance_m = np.abs(vertices[:, None] - merged[None]).max(axis=2).min(axis=1)
    assert distance_m.max() <= 0.01 + 1e-12


@given(hnp.arrays(np.float64, (30, 3), elements=st.floats(-0.1, 0.1)))
def test_clustered_faces_are_valid_and_not_degenerate(vertices: np.ndarray) -> None:
    merged, faces = cluster(vertices, np.arange(30, dtype=np.int32).reshape(10, 3), cell_m=0.02)
    if len(faces):
        assert faces.min() >= 0
        assert faces.max() < len(merged)
        assert all(len(set(face)) == 3 for face in faces.tolist())


def test_a_fine_grid_changes_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    merged, kept = cluster(vertices, faces, cell_m=1e-3)
    assert {tuple(map(tuple, merged[face])) for face in kept} == {tuple(map(tuple, vertices[face])) for face in faces}


def test_the_limits_are_the_models(world: Physics) -> None:
    limits = np.array([world.model.joint(name).range for name in panda.ARM_JOINTS])
    np.testing.assert_allclose(limits[:, 0], panda.JOINT_LOW_RAD)
    np.testing.assert_allclose(limits[:, 1], panda.JOINT_HIGH_RAD)


def test_limits_have_the_shape_of_state_and_action() -> None:
    robot = panda.PANDA_WRISTCAM
    for low, high in ((robot.state_low, robot.state_high), (robot.action_low, robot.action_high)):
        assert low.shape == high.shape == (8,)
        assert np.all(low < high)


@pytest.mark.parametrize(("command", "opening_m"), [(-1, -0.01), (1, 0.04), (0, 0.015), (-7, -0.01), (7, 0.04)])
def test_gripper_command_is_a_clipped_finger_target(command: float, opening_m: float) -> None:
    control = panda.PANDA_WRISTCAM.control_of(np.append(panda.HOME_QPOS, command))
    np.testing.assert_allclose(control[7:], [opening_m, -opening_m], atol=1e-15)


@given(st.floats(-1, 1))
def test_gripper_command_can_be_read_back(command: float) -> None:
    control = panda.PANDA_WRISTCAM.control_of(np.append(panda.HOME_QPOS, command))
    assert panda.PANDA_WRISTCAM.gripper_command_of(control) == pytest.approx(command, abs=1e-12)


def test_gains_are_upstreams(world: Physics) -> None:
    assert np.all(world.model.actuator_gainprm[:, 0] == 1000)
    assert np.all(world.model.actuator_biasprm[:, 2] == -100)
    assert np.all(world.model.actuator_forcerange == [-100, 100])
