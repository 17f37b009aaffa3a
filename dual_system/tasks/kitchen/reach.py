"""How well the Panda reaches poses from a place of its base: what scripts choose their ways of doing things by.

Everything happens on a scratch copy of the world. A way is judged by its worst pose: how far the joints stay from their
limits, how far the arm is from a singularity, and whether links, fingers apart, would be inside something.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array, rotation_log
from dual_system.tasks.kitchen import omron
from dual_system.tasks.kitchen.predicates import GRIP_SITE, HAND, View, geoms_below

Base = tuple[float, float]
"""Where the base stands, ahead and left of its stand [m]."""

UNREACHABLE = -1.0
_ITERATIONS, _DAMPING = 40, 1e-4
_NEAR = 0.006  # m, and a fifth of it in rad
_MANIPULABILITY = 8.0  # brings it to the size of joint margins in rad
_INSIDE_M = 0.004
_LIMIT_RAD = 0.03


class Reach:
    """Inverse kinematics of the Panda in a scene, started from where the arm is."""

    def __init__(self, view: View) -> None:
        model = view.model
        self._view, self._scratch = view, mujoco.MjData(model)
        joints = [model.joint(name) for name in omron.ARM_JOINTS]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._low = np.array([joint.range[0] for joint in joints]) + _LIMIT_RAD
        self._high = np.array([joint.range[1] for joint in joints]) - _LIMIT_RAD
        self._base = np.array([model.joint(name).qposadr[0] for name in omron.BASE_JOINTS[:2]])
        self._site, self._hand = model.site(GRIP_SITE).id, model.body(HAND).id
        self._jacobian = np.zeros((6, model.nv))
        fingers = frozenset().union(*(geoms_below(model, body) for body in omron.FINGER_BODIES))
        self._links = geoms_below(model, omron.ROOT_BODY) - fingers

    def base(self) -> Base:
        """Returns where the base stands now."""
        ahead_m, left_m = self._view.data.qpos[self._base]
        return float(ahead_m), float(left_m)

    def joints(self) -> Array:
        """Returns the arm's joints (7,) now."""
        return self._view.data.qpos[self._qpos].copy()

    def worth(
        self,
        poses: Sequence[Array],
        base: Base,
        *,
        joint: str = "",
        values: Sequence[float] = (),
        start: Array = omron.START_QPOS,
    ) -> tuple[float, Array]:
        """Returns how well poses (4, 4) are reached one after the other, and the arm's joints (7,) at the last one.

        A pose that is not reached makes it `UNREACHABLE` or less. A ``joint`` of the bay has one of ``values`` at each.
        """
        scratch, model = self._scratch, self._view.model
        scratch.qpos[:] = self._view.data.qpos
        scratch.qpos[self._base] = base
        worst, qpos = np.inf, start
        for i, pose in enumerate(poses):
            if joint:
                scratch.qpos[model.joint(joint).qposadr[0]] = values[i]
            qpos, miss = self._solve(pose, qpos)
            if miss > _NEAR:
                return UNREACHABLE - miss, qpos
            A = self._jacobian[:, self._dof]
            manipulability = np.sqrt(max(float(np.linalg.det(A @ A.T)), 0.0))
            margin = float(np.minimum(qpos - self._low, self._high - qpos).min())
            worst = min(worst, margin, _MANIPULABILITY * manipulability)
            mujoco.mj_collision(model, scratch)
            worst -= self._depth_m() * 20.0
        return float(worst), qpos

    def _solve(self, pose: Array, start: Array) -> tuple[Array, float]:
        """Joint angles near a start, drawn towards the arm's usual posture, and by how much they miss the pose."""
        model, scratch, qpos = self._view.model, self._scratch, start.copy()
        for left in reversed(range(_ITERATIONS)):
            scratch.qpos[self._qpos] = qpos
            mujoco.mj_kinematics(model, scratch)
            mujoco.mj_comPos(model, scratch)
            R = scratch.xmat[self._hand].reshape(3, 3)
            error = np.concatenate([pose[:3, 3] - scratch.site_xpos[self._site], rotation_log(pose[:3, :3] @ R.T)])
            mujoco.mj_jacSite(model, scratch, self._jacobian[:3], self._jacobian[3:], self._site)
            miss = float(np.linalg.norm(error[:3]) + 0.2 * np.linalg.norm(error[3:]))
            if left == 0 or miss < _NEAR / 10:
                break
            A = self._jacobian[:, self._dof]
            weighted = A.T @ np.linalg.inv(A @ A.T + _DAMPING * np.eye(6))
            step = weighted @ np.clip(error, -0.15, 0.15)
            step += 0.1 * ((omron.START_QPOS - qpos) - weighted @ (A @ (omron.START_QPOS - qpos)))
            qpos = np.clip(qpos + np.clip(step, -0.25, 0.25), self._low, self._high)
        return qpos, miss

    def _depth_m(self) -> float:
        """How deep links are inside other things, beyond a tolerance."""
        deep = 0.0
        for contact in self._scratch.contact:
            first, second = contact.geom
            if (int(first) in self._links) != (int(second) in self._links):
                deep = max(deep, -float(contact.dist) - _INSIDE_M)
        return deep
