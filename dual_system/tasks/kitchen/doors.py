"""Opening and shutting doors: taken by the bar and led along the arc, and pushed where they were left ajar."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import steps
from dual_system.tasks.kitchen.arm import Arm, Way
from dual_system.tasks.kitchen.handles import Hinge
from dual_system.tasks.kitchen.plan import Target
from dual_system.tasks.kitchen.predicates import hinges
from dual_system.tasks.kitchen.pushing import push
from dual_system.tasks.kitchen.reach import Base, Leg
from dual_system.tasks.kitchen.steps import AHEAD, UP, Step, Steps

_LOW_M, _WIDE_RAD, _HALF_SHUT_RAD = 1.3, 0.9, 0.7  # doors: a low bar, wide open, where to push it to shut it
_AROUND_M = -0.17 * AHEAD  # around the edge of an open leaf
_NUM_WAYS, _SPAN = 6, 7  # whose paths are followed, and poses along the arc of each
_ALIKE = 0.01  # paths at the joints' limits differ by less; then the grasp decides that is best all along the arc
_BACK_M = 0.1
_MORE_ATTEMPTS, _DONE_RAD = 2, 0.06
_BAR_OUT_M, _BESIDE_BAR_M, _PAST_RAD = 0.06, 0.08, 0.03  # of a leaf's face; where it is pushed, and how far
_PUSH_BACKS, _PUSH_LEFTS = (-0.3, -0.15), (-0.35, -0.2, 0.0, 0.2, 0.35)


def lead_doors(arm: Arm, target: Target, *, fraction: float) -> Steps:
    """Yields the steps that bring each door of a fixture to a fraction of its opening."""
    for i, door in enumerate(hinges(arm.view.bay, target.fixture)):
        if i:
            yield from arm.go_home()
        to_rad = fraction * door.open_rad
        yield from _lead_door(arm, door, to_rad)
        for _ in range(_MORE_ATTEMPTS):
            left_rad = abs(arm.view.angle(door.joint) - to_rad)
            if left_rad < _DONE_RAD:
                break
            if not to_rad and left_rad < _WIDE_RAD:
                yield from _push_shut(arm, door)
            else:
                yield from arm.go_home()
                yield from _lead_door(arm, door, to_rad)


def _push_shut(arm: Arm, door: Hinge) -> Steps:
    """Pushes a door that is ajar at its face, between bar and hinge, a little past the shut one."""
    grip, _, normal = door.at(arm.view.angle(door.joint))
    toward_hinge = (np.array(door.anchor_m) - grip) * [1.0, 1.0, 0.0]
    toward_hinge -= normal * (toward_hinge @ normal)
    toward_hinge /= np.linalg.norm(toward_hinge)
    face = grip - _BAR_OUT_M * normal + _BESIDE_BAR_M * toward_hinge
    past_rad = -_PAST_RAD * float(np.sign(door.open_rad))
    yield from push(arm, door, past_rad, face, from_side=normal, bases=tuple(product(_PUSH_BACKS, _PUSH_LEFTS)))


def _lead_door(arm: Arm, door: Hinge, to_rad: float) -> Steps:
    """Takes a door by its bar and leads it along its arc, or to half shut if it cannot be led all the way."""
    grasps = _door_grasps(door)
    now = arm.view.angle(door.joint)
    is_shutting = abs(now) > abs(to_rad)

    def way(grasp: _DoorGrasp, start_rad: float, end_rad: float, num: int = 4) -> Way:
        span = np.linspace(start_rad, end_rad, num).tolist()
        poses = tuple(grasp.at(door, angle) for angle in span)
        before = steps.backed(poses[0], _BACK_M)
        if abs(start_rad) > _WIDE_RAD and is_shutting:  # the open leaf is between the hand and its bar
            before = steps.moved(before, _AROUND_M)
        return Way(base=grasp.base, poses=(before, *poses), joint=door.joint, values=(start_rad, *span))

    half_rad = _HALF_SHUT_RAD * float(np.sign(now))
    ends = (to_rad, half_rad) if is_shutting and abs(now) > _WIDE_RAD else (to_rad,)
    ranked = [
        (grasps[i], end)
        for end in ends
        for _, i, _ in arm.rate_best([way(grasp, now, end) for grasp in grasps], _NUM_WAYS)
    ]
    paths = ([_leg(door, way(grasp, now, end, _SPAN))] for grasp, end in ranked)
    grasp, end = ranked[arm.first_free(paths, alike=_ALIKE)]
    yield from arm.drive(grasp.base)
    now = arm.view.angle(door.joint)  # the arm may have touched it
    before, frame, *_ = way(grasp, now, end).poses
    yield Step(pose=before)
    yield from steps.grasp(frame, door.joint)
    yield from steps.swing(door, now, end, frame, follow=grasp.follow)
    yield from steps.release(steps.here(arm.view))
    yield from steps.retreat(arm.view, back_m=_BACK_M)
    if not is_shutting:  # from the open leaf the hand goes back as it came
        yield Step(pose=steps.moved(steps.here(arm.view), _AROUND_M))
        yield Step(pose=before)


def _leg(door: Hinge, way: Way) -> Leg:
    """Returns the path of a way: to the bar, along the arc, back from it and, where that opens, to where it began."""
    before, frame, *_, last = way.poses
    away = steps.backed(last, _BACK_M)
    is_shutting = abs(way.values[-1]) < abs(way.values[0])
    ends = (away,) if is_shutting else (away, steps.moved(away, _AROUND_M), before)
    return Leg(
        base=way.base,
        poses=(before, steps.backed(frame, _BACK_M), *way.poses[1:], *ends),
        joint=door.joint,
        values=(way.values[0], *way.values, *[way.values[-1]] * len(ends)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _DoorGrasp:
    """How a door's bar is held: where the base stands, and how the hand turns with the leaf."""

    base: Base
    tilt_rad: float
    follow: float
    is_flipped: bool

    def at(self, door: Hinge, angle_rad: float) -> Array:
        """Returns the tool's pose (4, 4) at an angle of the door."""
        grip, bar, _ = door.at(angle_rad)
        toward = steps.about(UP, self.follow * angle_rad) @ AHEAD
        T = steps.tool(grip, steps.tilted(toward, self.tilt_rad), np.cross(bar, toward))
        return steps.flipped(T) if self.is_flipped else T


def _door_grasps(door: Hinge) -> list[_DoorGrasp]:
    side = -float(np.sign(door.open_rad))
    lefts: tuple[float, ...]
    if door.grip_m[2] < _LOW_M:  # a microwave's, whose door is wide as well
        backs, lefts, tilts, follows = (-0.3, -0.4), (-0.1, 0.05), (35.0, 50.0), (0.15, 0.5)
    else:
        backs, lefts, tilts, follows = (-0.15, -0.25), (-0.1, 0.05, 0.2, 0.35), (60.0, 75.0), (0.0, 0.2)
    return [
        _DoorGrasp(base=(back, left * side), tilt_rad=float(np.deg2rad(tilt)), follow=follow, is_flipped=flip)
        for back, left, tilt, follow, flip in product(backs, lefts, tilts, follows, (False, True))
    ]
