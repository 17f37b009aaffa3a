"""Joint angles and tool poses: forward, inverse, and the joint path of a straight screw motion.

Inverse kinematics is damped least squares from a nearby start. Its steps are the shortest in joint space, so a path
solved point by point stays smooth and resolves the arm's seventh degree of freedom as upstream's planner does.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from dual_system.tasks import panda
from dual_system.tasks.geometry import Array, rotation_log, screw_exp, screw_log

_DAMPING = 1e-4
_POSITION_TOLERANCE_M = 1e-5
_ROTATION_TOLERANCE_RAD = 1e-4
_MAX_ITERATIONS = 40


class UnreachableError(RuntimeError):
    """No joint angles within the limits put the tool there."""


class Kinematics:
    """The arm's kinematics on its own scratch copy of the world: nothing here moves the real one."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._scratch = mujoco.MjData(model)
        self._qpos = np.array([model.joint(name).qposadr[0] for name in panda.ARM_JOINTS])
        robot = panda.robot_in(model)
        self._fingers = np.array([model.joint(name).qposadr[0] for name in robot.finger_joints], dtype=int)
        self._open_fingers_m = robot.open_fingers_m
        self._dof = np.array([model.joint(name).dofadr[0] for name in panda.ARM_JOINTS])
        self._tcp = model.site(panda.TCP_SITE).id
        self._jacobian = np.zeros((6, model.nv))

    def tcp(self, qpos: Array) -> Array:
        """Returns the tool's transform (4, 4) at joint angles (7,)."""
        self._scratch.qpos[self._qpos] = qpos
        mujoco.mj_kinematics(self._model, self._scratch)
        T = np.eye(4)
        T[:3, :3] = self._scratch.site_xmat[self._tcp].reshape(3, 3)
        T[:3, 3] = self._scratch.site_xpos[self._tcp]
        return T

    def jacobian(self, qpos: Array) -> Array:
        """Returns d(tool)/d(joints) (6, 7) at joint angles (7,): linear rows, then angular, both in the world frame."""
        self.tcp(qpos)
        return self._jacobian_here()

    def solve(self, target: Array, start: Array, *, stopping_at_limits: bool = False) -> Array:
        """Returns joint angles (7,) near ``start`` (7,) that put the tool at ``target`` (4, 4).

        With ``stopping_at_limits`` a joint that would leave its limits stays there, if the other six can do without
        it. Raises UnreachableError if 40 steps do not get within 0.01 mm and 1e-4 rad, or lead out of the limits.
        """
        qpos = self._descend(target, start, np.ones(len(start)))
        if stopping_at_limits and _beyond_limits(qpos).max() > 0:
            joint = int(_beyond_limits(qpos).argmax())
            held = qpos.clip(panda.JOINT_LOW_RAD, panda.JOINT_HIGH_RAD)[joint]
            is_free = np.arange(len(qpos)) != joint
            qpos = self._descend(target, np.where(is_free, start, held), is_free.astype(np.float64))
        beyond = _beyond_limits(qpos)
        if beyond.max() > 0:
            joint = int(beyond.argmax())
            raise UnreachableError(
                f"reaching {target[:3, 3].round(4)} m turns joint {joint + 1} to {qpos[joint]:.3f} rad, limits "
                f"[{panda.JOINT_LOW_RAD[joint]}, {panda.JOINT_HIGH_RAD[joint]}]"
            )
        return qpos

    def screw_path(self, start: Array, target: Array, num_points: int, *, stopping_at_limits: bool = False) -> Array:
        """Returns joint angles (num_points, 7) along the constant screw from ``start`` (7,) to ``target`` (4, 4).

        The first row is ``start``. Raises UnreachableError if a point of the way is; see `solve`.
        """
        origin = self.tcp(start)
        twist = screw_log(np.linalg.inv(origin) @ target)
        path = [start]
        for fraction in np.linspace(0.0, 1.0, num_points)[1:]:
            path.append(
                self.solve(origin @ screw_exp(fraction * twist), path[-1], stopping_at_limits=stopping_at_limits)
            )
        return np.array(path)

    def _descend(self, target: Array, start: Array, mobility: Array) -> Array:
        """Damped least squares from ``start`` (7,); joints whose mobility (7,) is 0 stay, the others' is 1."""
        qpos = start.copy()
        for _ in range(_MAX_ITERATIONS):
            here = self.tcp(qpos)
            error = np.concatenate([target[:3, 3] - here[:3, 3], rotation_log(target[:3, :3] @ here[:3, :3].T)])
            if np.abs(error[:3]).max() < _POSITION_TOLERANCE_M and np.abs(error[3:]).max() < _ROTATION_TOLERANCE_RAD:
                return qpos
            J = self._jacobian_here() * mobility
            qpos = qpos + J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), error)
        raise UnreachableError(f"the arm cannot reach {target[:3, 3].round(4)} m from {start.round(3)} rad")

    def overlap_m(self, world: Any, qpos: Array, ignored_body: str) -> float:
        """Returns the arm's penetration into objects [m] at joint angles (7,) with open fingers; 0 if it is free.

        Args: world is the MjData whose props are in the way, which is only read; one body of it does not count.
        """
        self._scratch.qpos[:] = world.qpos
        self._scratch.mocap_pos[:], self._scratch.mocap_quat[:] = world.mocap_pos, world.mocap_quat
        self._scratch.qpos[self._fingers] = self._open_fingers_m
        self.tcp(qpos)
        mujoco.mj_collision(self._model, self._scratch)
        geoms = self._scratch.contact.geom
        is_met = np.any(self._model.geom_contype[geoms] == panda.ROBOT_BIT, axis=1)
        is_met &= np.all(self._model.geom_bodyid[geoms] != self._model.body(ignored_body).id, axis=1)
        return float(-self._scratch.contact.dist[is_met].min(initial=0.0))

    def _jacobian_here(self) -> Array:
        mujoco.mj_comPos(self._model, self._scratch)  # mj_jacSite reads what it computes
        mujoco.mj_jacSite(self._model, self._scratch, self._jacobian[:3], self._jacobian[3:], self._tcp)
        return self._jacobian[:, self._dof]


def _beyond_limits(qpos: Array) -> Array:
    """How far joint angles (7,) are out of their limits [rad]; negative within."""
    return np.maximum(panda.JOINT_LOW_RAD - qpos, qpos - panda.JOINT_HIGH_RAD)
