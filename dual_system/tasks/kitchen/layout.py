"""The 53 numbers of RoboCasa's state and the 12 of its action, in its order, and how physics fills the state.

Quaternions are xyzw, unchanged: whoever flips a sign to make the scalar positive has another layout. LeRobot's
RoboCasa365 orders its 12 numbers otherwise.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import omron

_XYZ, _XYZW = ("x", "y", "z"), ("x", "y", "z", "w")

STATE_PARTS: tuple[tuple[str, int], ...] = (
    ("joint_pos", 7),  # rad
    ("joint_pos_cos", 7),
    ("joint_pos_sin", 7),
    ("joint_vel", 7),  # rad/s
    ("eef_pos", 3),  # m, world
    ("eef_quat", 4),  # of the hand's body, world
    ("gripper_qpos", 2),  # m, the second finger opens towards negative values
    ("gripper_qvel", 2),  # m/s
    ("base_pos", 3),  # m, world: where the arm stands on the base
    ("base_quat", 4),
    ("base_to_eef_pos", 3),  # m
    ("base_to_eef_quat", 4),
)
ACTION_PARTS: tuple[tuple[str, int], ...] = (
    ("arm_position", 3),  # 0.05 m per unit, frame of the base
    ("arm_rotation", 3),  # 0.5 rad per unit, rotation vector, frame of the base
    ("gripper", 1),  # > 0 closes, < 0 opens
    ("base_velocity", 3),  # forward, left, turn to the left: 1 m/s, 1 m/s, 1.5 rad/s per unit
    ("torso", 1),  # 0.05 m per unit, up
    ("mode", 1),  # > 0: the arm's goal rides with the base; else it is counted from where the hand is
)
NUM_STATE = sum(size for _, size in STATE_PARTS)
NUM_ACTION = sum(size for _, size in ACTION_PARTS)


def _slices(parts: tuple[tuple[str, int], ...]) -> dict[str, slice]:
    ends = np.cumsum([size for _, size in parts])
    return {name: slice(int(end) - size, int(end)) for (name, size), end in zip(parts, ends, strict=True)}


STATE = _slices(STATE_PARTS)
"""Where a part of the state is: ``state[STATE["eef_quat"]]``."""

ACTION = _slices(ACTION_PARTS)


def _names(parts: tuple[tuple[str, int], ...]) -> tuple[str, ...]:
    names: list[str] = []
    for name, size in parts:
        if size == 1:
            names.append(name)
            continue
        axes: tuple[Any, ...] = {3: _XYZ, 4: _XYZW}.get(size, tuple(range(1, size + 1)))
        names += [f"{name}_{axis}" for axis in axes]
    return tuple(names)


STATE_NAMES = _names(STATE_PARTS)
ACTION_NAMES = _names(ACTION_PARTS)


class StateReader:
    """Reads the state of the PandaOmron in a compiled scene."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._arm_qpos = np.array([model.joint(name).qposadr[0] for name in omron.ARM_JOINTS])
        self._arm_qvel = np.array([model.joint(name).dofadr[0] for name in omron.ARM_JOINTS])
        self._finger_qpos = np.array([model.joint(name).qposadr[0] for name in omron.FINGER_JOINTS])
        self._finger_qvel = np.array([model.joint(name).dofadr[0] for name in omron.FINGER_JOINTS])
        self._grip = model.site(omron.GRIP_SITE).id
        self._hand = model.body(omron.HAND_BODY).id
        self._base = model.site(omron.BASE_SITE).id

    def state(self, data: mujoco.MjData) -> Array:
        """Returns the state (53,); the poses in ``data`` must be up to date."""
        joints = data.qpos[self._arm_qpos]
        eef_m, base_m = data.site_xpos[self._grip], data.site_xpos[self._base]
        hand, base = data.xmat[self._hand].reshape(3, 3), data.site_xmat[self._base].reshape(3, 3)
        return np.concatenate(
            [
                joints,
                np.cos(joints),
                np.sin(joints),
                data.qvel[self._arm_qvel],
                eef_m,
                np.roll(data.xquat[self._hand], -1),
                data.qpos[self._finger_qpos],
                data.qvel[self._finger_qvel],
                base_m,
                quaternion_xyzw(base),
                base.T @ (eef_m - base_m),
                quaternion_xyzw(base.T @ hand),
            ]
        )


def quaternion_xyzw(rotation: NDArray[np.float64]) -> Array:
    """Returns the quaternion (4,) xyzw of a rotation (3, 3), with w >= 0 as robosuite's conversion has it."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return np.roll(quaternion if quaternion[0] >= 0 else -quaternion, -1)
