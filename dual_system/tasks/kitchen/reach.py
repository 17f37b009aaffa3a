"""How well the Panda reaches poses from a place of its base: what scripts choose their ways of doing things by.

Everything happens on a scratch copy of the world. A way is judged by its worst pose: how far the joints stay from their
limits, how far the arm is from a singularity, and whether links, fingers apart, would be inside something.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array, rotation_log
from dual_system.tasks.kitchen import omron, steps
from dual_system.tasks.kitchen.predicates import GRIP_SITE, HAND, View, geoms_below

Base = tuple[float, float]
"""Where the base stands, ahead and left of its stand [m]."""

UNREACHABLE = -1.0
_ITERATIONS, _DAMPING = 40, 1e-4
_PATIENCE, _STALLED = 10, 0.7  # iterations after which at least that share of the miss must have gone
_POSTURE, _POSTURE_STRIDE = 0.1, 0.15  # of the way to the usual posture: in an iteration, and in a stride
_MAX_ERROR, _MAX_STEP_RAD = 0.15, 0.25  # of an iteration
_NEAR = 0.006  # m, and a fifth of it in rad
_MANIPULABILITY = 8.0  # brings it to the size of joint margins in rad
_INSIDE_M, _TOUCHING_M = 0.004, 0.0015  # depths that count as none: of rated poses, and of paths
_LIMIT_RAD = 0.03
_DEPTH_COST = 20.0  # of worth, a metre
_STRIDE_M, _STRIDE_RAD = 0.03, 0.25  # between the poses of a path at which it is looked at
_DRIVE_LOOKS = 8  # at a drive of the base


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A part of a path for which the base stands still: poses (4, 4) that straight lines of the tool lead to."""

    base: Base
    poses: Sequence[Array]
    carries: str = ""  # the object in the hand
    joint: str = ""  # what the tool leads on the way
    values: Sequence[float] = ()  # of it, one a pose
    open_m: float = omron.OPEN_M  # of each finger that carries nothing


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
        self._jacobian, self._damping = np.zeros((6, model.nv)), _DAMPING * np.eye(6)
        self._robot = geoms_below(model, omron.ROOT_BODY)
        self._links = self._robot.difference(*(geoms_below(model, body) for body in omron.FINGER_BODIES))
        self._fingers = np.array([model.joint(name).qposadr[0] for name in omron.FINGER_JOINTS])

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
        floor: float = -np.inf,
    ) -> tuple[float, Array]:
        """Returns how well poses (4, 4) are reached one after the other, and the arm's joints (7,) at the last one.

        A pose that is not reached makes it `UNREACHABLE` or less. A ``joint`` of the bay has one of ``values`` at each.
        What is worth no more than a ``floor`` is not looked at to its end.
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
            worst = min(worst, self._ease(qpos))
            mujoco.mj_collision(model, scratch)
            worst -= _DEPTH_COST * self._depth_m(self._links)
            if worst <= floor:
                break
        return float(worst), qpos

    def follow(self, path: Sequence[Leg], floor: float = -np.inf) -> float:
        """Returns how well the arm follows a path from where it is, with what it carries and fingers counted in.

        Between legs the base drives with its arm held still. A pose that is not reached makes it `UNREACHABLE` or less.
        What is worth no more than a ``floor`` is not looked at to its end.
        """
        scratch, qpos = self._scratch, self.joints()
        scratch.qpos[:] = self._view.data.qpos
        worst, deep_m, carries, grip = np.inf, 0.0, "", np.eye(4)
        for leg in path:
            if leg.carries and not carries:
                grip = np.linalg.inv(self._tool()) @ self._pose(leg.carries)
            carries = leg.carries
            open_m = self._view.bay.objects[carries].grasp_width_m / 2 if carries else leg.open_m
            scratch.qpos[self._fingers] = open_m, -open_m
            for base in np.linspace(scratch.qpos[self._base], leg.base, _DRIVE_LOOKS + 1)[1:]:
                scratch.qpos[self._base] = base
                deep_m = max(deep_m, self._depth_with_m(carries, grip))
            led = self._view.model.joint(leg.joint).qposadr[0] if leg.joint else None
            values = [scratch.qpos[led], *leg.values] if led is not None else [0.0] * (len(leg.poses) + 1)
            for pose, value in _dense([self._tool(), *leg.poses], values):
                if led is not None:
                    scratch.qpos[led] = value
                qpos, miss = self._solve(pose, qpos, is_near=True)
                if miss > _NEAR:
                    return UNREACHABLE - miss
                worst = min(worst, self._ease(qpos))
                deep_m = max(deep_m, self._depth_with_m(carries, grip))
                if worst - _DEPTH_COST * deep_m <= floor:
                    return worst - _DEPTH_COST * deep_m
        return worst - _DEPTH_COST * deep_m

    def _depth_with_m(self, carries: str, grip: Array) -> float:
        """Takes along what the hand carries; returns how deep that and the robot are inside other things."""
        moving = self._robot
        if carries:
            self._put(carries, self._tool() @ grip)
            moving = moving | self._view.geoms[carries]
        mujoco.mj_kinematics(self._view.model, self._scratch)
        mujoco.mj_collision(self._view.model, self._scratch)
        return self._depth_m(moving, _TOUCHING_M)

    def _ease(self, qpos: Array) -> float:
        """How far solved joints (7,) are from their limits, or from a singularity [rad]."""
        A = self._jacobian[:, self._dof]
        manipulability = np.sqrt(max(float(np.linalg.det(A @ A.T)), 0.0))
        margin = float(np.minimum(qpos - self._low, self._high - qpos).min())
        return min(margin, float(_MANIPULABILITY * manipulability))

    def _tool(self) -> Array:
        """The tool's pose (4, 4) in the scratch copy."""
        mujoco.mj_kinematics(self._view.model, self._scratch)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._scratch.xmat[self._hand].reshape(3, 3), self._scratch.site_xpos[self._site]
        return T

    def _pose(self, name: str) -> Array:
        """The pose (4, 4) of an object in the scratch copy, whose poses are up to date."""
        body = self._scratch.body(name)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return T

    def _put(self, name: str, T: Array) -> None:
        first = int(self._view.model.joint(name).qposadr[0])
        self._scratch.qpos[first : first + 3] = T[:3, 3]
        mujoco.mju_mat2Quat(self._scratch.qpos[first + 3 : first + 7], T[:3, :3].ravel())

    def _solve(self, pose: Array, start: Array, *, is_near: bool = False) -> tuple[Array, float]:
        """Joint angles near a start, drawn towards the arm's usual posture, and by how much they miss the pose.

        If the pose ``is_near``, a stride away, they are drawn by no more than the controller does on the way.
        """
        model, scratch, qpos, before = self._view.model, self._scratch, start.copy(), np.inf
        for left in reversed(range(_ITERATIONS)):
            scratch.qpos[self._qpos] = qpos
            mujoco.mj_kinematics(model, scratch)
            mujoco.mj_comPos(model, scratch)
            R = scratch.xmat[self._hand].reshape(3, 3)
            error = np.concatenate([pose[:3, 3] - scratch.site_xpos[self._site], rotation_log(pose[:3, :3] @ R.T)])
            mujoco.mj_jacSite(model, scratch, self._jacobian[:3], self._jacobian[3:], self._site)
            miss = float(np.linalg.norm(error[:3]) + 0.2 * np.linalg.norm(error[3:]))
            if left == 0 or miss < _NEAR / 10 or (left % _PATIENCE == 0 and miss > _STALLED * before):
                break
            before = miss if left % _PATIENCE == 0 else before
            A = self._jacobian[:, self._dof]
            share = _POSTURE if not is_near else _POSTURE_STRIDE if left == _ITERATIONS - 1 else 0.0
            away = share * (omron.START_QPOS - qpos)
            pull = np.minimum(np.maximum(error, -_MAX_ERROR), _MAX_ERROR) - A @ away
            step = A.T @ np.linalg.solve(A @ A.T + self._damping, pull) + away
            step = np.minimum(np.maximum(step, -_MAX_STEP_RAD), _MAX_STEP_RAD)
            qpos = np.minimum(np.maximum(qpos + step, self._low), self._high)
        return qpos, miss

    def _depth_m(self, moving: frozenset[int], tolerance_m: float = _INSIDE_M) -> float:
        """How deep moving geoms are inside others, beyond a tolerance."""
        geoms, dist_m = self._scratch.contact.geom, self._scratch.contact.dist
        is_moving = np.isin(geoms, list(moving))
        return max(0.0, -float(dist_m[is_moving[:, 0] != is_moving[:, 1]].min(initial=0.0)) - tolerance_m)


def _dense(poses: Sequence[Array], values: Sequence[float]) -> list[tuple[Array, float]]:
    """Returns what follows the first pose and value, with so many in between that each is a stride from the next."""
    dense: list[tuple[Array, float]] = []
    for (T, value), (there, last) in pairwise(zip(poses, values, strict=True)):
        turn_rad = float(np.linalg.norm(rotation_log(there[:3, :3] @ T[:3, :3].T)))
        num = int(max(float(np.linalg.norm(there[:3, 3] - T[:3, 3])) / _STRIDE_M, turn_rad / _STRIDE_RAD))
        dense += zip([*steps.between(T, there, num), there], np.linspace(value, last, num + 2)[1:], strict=True)
    return dense
