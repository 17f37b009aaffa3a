"""The controller of a PandaOmron: 12 numbers at 20 Hz become torques and velocities in every physics step.

The arm is controlled in operational space (Khatib, 1987): the hand behaves like a mass on a critically damped spring of
150 1/s^2 whose anchor is the commanded pose in the frame of the base; posture is kept in the null space. This is the
law of robosuite's OSC_POSE in HYBRID_MOBILE_BASE, and `tests/tasks/kitchen` compares the two step by step.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import omron
from dual_system.tasks.kitchen.layout import ACTION, NUM_ACTION

CONTROL_HZ = 20
POSITION_M, ROTATION_RAD = 0.05, 0.5
"""What one unit of the arm's action means."""

BASE_VELOCITY = np.array([1.0, 1.0, 1.5])
"""What one unit of the base's action means: m/s, m/s, rad/s. Its friction of 250 N swallows the first quarter."""

_KP, _KD = 150.0, 2 * np.sqrt(150.0)
_POSTURE_KP, _POSTURE_KD = 10.0, 2 * np.sqrt(10.0)
_TORSO_M, _TORSO_KP, _TORSO_KD = 0.05, 2000.0, 2 * np.sqrt(2000.0)
_GRIPPER_SPEED = 0.2  # of the fingers' targets in [-1, 1], per control step


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """What the controller remembers between control steps, besides the physics."""

    position_m: Array  # (3,) of the hand, frame of the arm's base
    rotation: Array  # (3, 3)
    torso_m: float
    base_velocity: Array  # (3,) frame of the base's joints


class Controller:
    """Controls the PandaOmron of one compiled scene. Its state is `goal`, which is frozen: save and restore that."""

    goal: Goal

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._substeps = round(1.0 / (CONTROL_HZ * model.opt.timestep))
        self._grip = model.site(omron.GRIP_SITE).id
        self._origin = model.site(omron.ARM_SITE).id
        self._qpos = np.array([model.joint(name).qposadr[0] for name in omron.ARM_JOINTS])
        self._dof = np.array([model.joint(name).dofadr[0] for name in omron.ARM_JOINTS])
        self._block = np.ix_(self._dof, self._dof)
        self._arm = np.array([model.actuator(name).id for name in omron.ARM_MOTORS])
        self._fingers = np.array([model.actuator(name).id for name in omron.FINGER_MOTORS])
        self._base = np.array([model.actuator(name).id for name in omron.BASE_MOTORS])
        self._torso = model.actuator(omron.TORSO_MOTOR).id
        torso, yaw = model.joint(omron.TORSO_JOINT), model.joint(omron.BASE_JOINTS[2])
        self._torso_qpos, self._torso_dof, self._yaw_qpos = torso.qposadr[0], torso.dofadr[0], yaw.qposadr[0]
        self._torque_range = model.actuator_ctrlrange[self._arm]
        self._finger_range_m = model.actuator_ctrlrange[self._fingers]
        self._closing_m = np.array([-1.0, 1.0]) * _GRIPPER_SPEED / 2 * np.ptp(self._finger_range_m, axis=1)
        self._jacobian = np.zeros((6, model.nv))
        self._mass = np.zeros((model.nv, model.nv))

    def begin(self, data: mujoco.MjData) -> None:
        """Forgets the past: the goal is where the hand is, the base rests, and the fingers go half open."""
        position_m, rotation = self.hand(data)
        self.goal = Goal(
            position_m=position_m,
            rotation=rotation,
            torso_m=float(data.qpos[self._torso_qpos]),
            base_velocity=np.zeros(3),
        )
        data.ctrl[self._fingers] = self._finger_range_m.mean(axis=1)

    def hand(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Returns the hand's position (3,) and rotation (3, 3) in the frame of the arm's base."""
        origin = data.site_xmat[self._origin].reshape(3, 3)
        position_m = origin.T @ (data.site_xpos[self._grip] - data.site_xpos[self._origin])
        return position_m, origin.T @ data.site_xmat[self._grip].reshape(3, 3)

    def advance(self, data: mujoco.MjData, action: Array) -> None:
        """Performs an action (12,) for one control step of exactly 50 ms. Numbers beyond [-1, 1] are clipped."""
        values = np.clip(action, -1.0, 1.0)
        assert values.shape == (NUM_ACTION,)
        for substep in range(self._substeps):
            mujoco.mj_step1(self._model, data)
            if substep == 0:
                self._set_goal(data, values)
            self._drive(data)
            mujoco.mj_step2(self._model, data)
        mujoco.mj_forward(self._model, data)

    def _set_goal(self, data: mujoco.MjData, action: Array) -> None:
        rides = action[ACTION["mode"]][0] > 0
        position_m, rotation = (self.goal.position_m, self.goal.rotation) if rides else self.hand(data)
        turn = rotation_of(ROTATION_RAD * action[ACTION["arm_rotation"]])
        cos, sin = np.cos(data.qpos[self._yaw_qpos]), np.sin(data.qpos[self._yaw_qpos])
        forward, left, yaw = action[ACTION["base_velocity"]]
        self.goal = Goal(
            position_m=position_m + POSITION_M * action[ACTION["arm_position"]],
            rotation=turn @ rotation,
            torso_m=float(data.qpos[self._torso_qpos] + _TORSO_M * action[ACTION["torso"]][0]),
            # The base's sliding joints do not turn with it. robosuite turns them back by the wrong sign, so that a base
            # that has turned drives askew; the data was recorded that way.
            base_velocity=np.array([forward * cos + left * sin, -forward * sin + left * cos, yaw]) * BASE_VELOCITY,
        )
        data.ctrl[self._fingers] = np.clip(
            data.ctrl[self._fingers] + np.sign(action[ACTION["gripper"]][0]) * self._closing_m, *self._finger_range_m.T
        )

    def _drive(self, data: mujoco.MjData) -> None:
        model, goal = self._model, self.goal
        mujoco.mj_jacSite(model, data, self._jacobian[:3], self._jacobian[3:], self._grip)
        mujoco.mj_fullM(model, self._mass, data.qM)
        velocity = self._velocity(data, self._grip) - self._velocity(data, self._origin)
        origin = data.site_xmat[self._origin].reshape(3, 3)
        lag_m = data.site_xpos[self._origin] + origin @ goal.position_m - data.site_xpos[self._grip]
        turn = _rotation_error(origin @ goal.rotation, data.site_xmat[self._grip].reshape(3, 3))
        pull = _KP * np.concatenate([lag_m, turn]) - _KD * velocity

        J, M = self._jacobian[:, self._dof], self._mass[self._block]
        MiJT = np.linalg.solve(M, J.T)  # (7, 6)
        inertia_inv = J @ MiJT
        blocks = np.stack([inertia_inv[:3, :3], inertia_inv[3:, 3:]])  # positions and turns are decoupled
        wrench = np.linalg.solve(blocks, pull.reshape(2, 3, 1)).ravel()
        away = omron.START_QPOS - data.qpos[self._qpos]
        posture = M @ (_POSTURE_KP * away - _POSTURE_KD * data.qvel[self._dof])
        posture -= J.T @ np.linalg.solve(inertia_inv, MiJT.T @ posture)
        torque = J.T @ wrench + posture + data.qfrc_bias[self._dof]
        data.ctrl[self._arm] = np.clip(torque, *self._torque_range.T)
        lift = _TORSO_KP * (goal.torso_m - data.qpos[self._torso_qpos]) - _TORSO_KD * data.qvel[self._torso_dof]
        data.ctrl[self._torso] = self._mass[self._torso_dof, self._torso_dof] * lift + data.qfrc_bias[self._torso_dof]
        data.ctrl[self._base] = goal.base_velocity

    def _velocity(self, data: mujoco.MjData, site: int) -> Array:
        """Returns a site's velocity (6,), linear, then angular, in the world's axes."""
        found = np.empty(6)
        mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_SITE, site, found, 0)
        return np.roll(found, 3)


def rotation_of(vector: Array) -> Array:
    """Returns the rotation (3, 3) about a rotation vector (3,) in radians."""
    quaternion, rotation = np.empty(4), np.empty(9)
    angle = float(np.linalg.norm(vector))
    mujoco.mju_axisAngle2Quat(quaternion, vector / max(angle, 1e-12), angle)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3)


def _rotation_error(wanted: Array, found: Array) -> Array:
    """Half the sum of the cross products of the axes: sin(angle) times the axis (3,), as robosuite's controller."""
    skew = wanted @ found.T
    return 0.5 * np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]])
