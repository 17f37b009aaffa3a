"""Demonstrations by GR-1: a puppet whose right hand goes where the Panda's went, in the Panda's scene.

The scene moves as it did under the Panda's real contacts; the puppet touches nothing. Its waist and right arm follow
the recorded tool by damped least squares. It has less reach and other wrists than the Panda, so that its hand is
placed more exactly than it is turned, and it stands where it reaches best, at most a step from its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.geometry import Array, rotation_log
from dual_system.tasks.kitchen import gr1, omron
from dual_system.tasks.kitchen.bay import ROBOT_STAND, build_bay
from dual_system.tasks.kitchen.catalogue import Family
from dual_system.tasks.kitchen.plan import Scene
from dual_system.tasks.kitchen.steps import flipped, here
from dual_system.tasks.kitchen.world import World, WorldState

CAMERA = "demonstration"
_VIEWS: dict[Family, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "pnp": ((0.85, -1.65, 1.95), (0.0, -0.40, 1.10)),
    "doors": ((1.00, -2.35, 1.80), (0.0, -0.35, 1.55)),
    "drawers": ((0.95, -2.00, 1.60), (0.0, -0.75, 0.85)),
    "sink": ((0.80, -1.50, 1.85), (0.0, -0.35, 1.05)),
    "stove": ((0.80, -1.60, 1.85), (0.0, -0.45, 0.95)),
    "microwave": ((0.85, -1.65, 1.85), (0.0, -0.35, 1.10)),
    "coffee": ((0.80, -1.50, 1.75), (0.0, -0.35, 1.10)),
}  # eye and aim of each family's camera: x from the robot's stand, y and z of the world
_FOVY_DEG = 50.0

_ITERATIONS, _DAMPING, _TURN_WEIGHT, _POSTURE = 12, 2e-3, 0.12, 0.02
_STANDS_M = tuple(product((0.0, -0.2, 0.2, -0.4, 0.4), (0.0, -0.15)))  # along the wall, and back from it
_BLEND_STEPS = 16  # control steps in which the hand goes from its own start to the tool's way
_SOLVED_EVERY = 4  # control steps between two poses of the puppet


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """One control step of an execution: what the puppet shows of it, and the Panda's world, to be looked at later."""

    qpos: Array  # of the bay's joints, in the order of `bay_joints`
    tool: Array  # (4, 4)
    closing: float
    world: WorldState
    action: Array | None  # (12,) what is done next; None at the end


class Puppet:
    """GR-1 in a scene. It is posed by `follow`; `data` can be rendered with the camera `CAMERA`."""

    def __init__(self, scene: Scene, family: Family) -> None:
        spec, self.bay = build_bay(scene.plan)
        self._joints = tuple(joint.name for joint in spec.joints)
        stand = scene.plan.stand
        eye, aim = (np.array([stand.x_m + x, y, z]) for x, y, z in _VIEWS[family])
        spec.worldbody.add_camera(name=CAMERA, pos=eye, xyaxes=_looking(aim - eye), fovy=_FOVY_DEG)
        spec.attach(gr1.gr1_spec(), prefix="", site=ROBOT_STAND)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = self.model.qpos0
        gr1.start(self.model, self.data)
        moved = [self.model.joint(name) for name in (*gr1.WAIST_JOINTS, *gr1.ARM_JOINTS)]
        self._qpos = np.array([joint.qposadr[0] for joint in moved])
        self._dof = np.array([joint.dofadr[0] for joint in moved])
        self._low, self._high = np.array([joint.range for joint in moved]).T
        self._rest = self.data.qpos[self._qpos].copy()
        self._tool = self.model.site(gr1.TOOL_SITE).id
        self._jacobian = np.zeros((6, self.model.nv))
        self._scene_qpos = _addresses(self.model, self._joints)
        self._root = self.model.body(gr1.ROOT_BODY).id
        self._stand_m = self.model.body_pos[self._root].copy()

    def poses(self, moments: Sequence[Moment]) -> list[Array]:
        """Returns the whole qpos for every moment, the puppet's own included."""
        shown = [*range(0, len(moments), _SOLVED_EVERY)]
        tools = [moments[k].tool for k in shown]
        _, stand_m, is_flipped = min(
            (self._miss([flipped(T) if flip else T for T in tools[:: 20 // _SOLVED_EVERY]], np.array(at)), at, flip)
            for at, flip in product(_STANDS_M, (False, True))
        )
        self._stand(np.array(stand_m))
        own = self._hand()
        found, qpos = [], self._rest
        for k, T in zip(shown, tools, strict=True):
            goal = flipped(T) if is_flipped else T.copy()
            goal = _between(own, goal, min(1.0, k / _BLEND_STEPS))
            qpos = self._solve(goal, qpos)
            found.append(qpos)
        return [self._whole(moment, _mix(found, k / _SOLVED_EVERY)) for k, moment in enumerate(moments)]

    def pose(self, qpos: Array) -> None:
        """Puts everything to a qpos that `poses` has returned."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)

    def _whole(self, moment: Moment, own: Array) -> Array:
        self.data.qpos[self._scene_qpos] = moment.qpos
        self.data.qpos[self._qpos] = own
        gr1.curl(self.model, self.data, "right", moment.closing)
        return self.data.qpos.copy()

    def _stand(self, offset_m: Array) -> None:
        """Puts the feet beside their place: along the wall, and back from it."""
        self.model.body_pos[self._root] = self._stand_m + np.array([*offset_m, 0.0])
        self.data.qpos[self._qpos] = self._rest
        mujoco.mj_kinematics(self.model, self.data)

    def _hand(self) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.site_xmat[self._tool].reshape(3, 3), self.data.site_xpos[self._tool]
        return T

    def _miss(self, tools: Sequence[Array], offset_m: Array) -> float:
        """By how much the hand misses the tool from a place of the feet, on average, turns counted a little."""
        self._stand(offset_m)
        qpos, misses = self._rest, []
        for T in tools:
            qpos = self._solve(T, qpos)
            misses.append(float(np.linalg.norm(self._error(T))))
        return float(np.mean(misses)) + 0.02 * float(np.abs(offset_m).sum())

    def _error(self, T: Array) -> Array:
        hand = self._hand()
        return np.concatenate([T[:3, 3] - hand[:3, 3], _TURN_WEIGHT * rotation_log(T[:3, :3] @ hand[:3, :3].T)])

    def _solve(self, T: Array, start: Array) -> Array:
        """Returns joint angles (10,) near a start whose hand is as near to a tool as it gets."""
        model, data, qpos = self.model, self.data, start.copy()
        for _ in range(_ITERATIONS):
            data.qpos[self._qpos] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, self._jacobian[:3], self._jacobian[3:], self._tool)
            J = self._jacobian[:, self._dof] * np.array([1.0] * 3 + [_TURN_WEIGHT] * 3)[:, None]
            pulled = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), np.clip(self._error(T), -0.2, 0.2))
            qpos = np.clip(qpos + np.clip(pulled, -0.2, 0.2) + _POSTURE * (self._rest - qpos), self._low, self._high)
        data.qpos[self._qpos] = qpos
        mujoco.mj_kinematics(model, data)
        return qpos


def record(world: World, actions: Iterable[Array]) -> list[Moment]:
    """Plays actions in a world and returns its moments, the first before the first action."""
    names = [joint for joint in _joint_names(world.model) if joint not in _PANDA_JOINTS]
    addresses = _addresses(world.model, names)
    fingers = [world.model.joint(name).qposadr[0] for name in omron.FINGER_JOINTS]

    def moment(action: Array | None) -> Moment:
        opening_m = np.abs(world.data.qpos[fingers]).mean()
        return Moment(
            qpos=world.data.qpos[addresses],
            tool=here(world.view),
            closing=float(1.0 - opening_m / omron.OPEN_M),
            world=world.save(),
            action=action,
        )

    moments = []
    for action in actions:
        moments.append(moment(action))
        world.advance(action)
    return [*moments, moment(None)]


_PANDA_JOINTS = {*omron.ARM_JOINTS, *omron.FINGER_JOINTS, *omron.BASE_JOINTS, omron.TORSO_JOINT}


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(i).name for i in range(model.njnt)]


def _addresses(model: mujoco.MjModel, joints: Sequence[str]) -> NDArray[np.int64]:
    """Where joints are in qpos: seven places of a free one, else one."""
    sizes = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    found: list[int] = []
    for name in joints:
        joint = model.joint(name)
        first = int(joint.qposadr[0])
        found += range(first, first + sizes.get(mujoco.mjtJoint(int(joint.type[0])), 1))
    return np.array(found)


def _looking(direction: Array) -> list[float]:
    right = np.cross(direction, [0.0, 0.0, 1.0])
    return [*right, *np.cross(right, direction)]


def _between(a: Array, b: Array, share: float) -> Array:
    """A pose on the way from one to another; its rotation is the other's."""
    T = b.copy()
    T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return T


def _mix(found: Sequence[Array], at: float) -> Array:
    first = min(int(at), len(found) - 1)
    second = min(first + 1, len(found) - 1)
    return found[first] + (at - first) * (found[second] - found[first])
