"""Pushing a lever, a spout or a door along its arc with closed fingers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import steps
from dual_system.tasks.kitchen.arm import Arm, Way
from dual_system.tasks.kitchen.handles import Hinge
from dual_system.tasks.kitchen.reach import Base, Leg
from dual_system.tasks.kitchen.steps import AHEAD, SHUT, UP, Step, Steps

_BASES: tuple[Base, ...] = tuple(product((0.0, -0.15), (-0.2, 0.0, 0.2)))
_NUM_WAYS, _SPAN = 8, 7  # whose paths are followed, and poses along the arc of each
_BACK_M = 0.12
_FINGER_M = 0.016  # from what is pushed to the middle of closed fingers


def push(
    arm: Arm, hinge: Hinge, to_rad: float, contact_m: Array, *, from_side: Array, bases: Sequence[Base] = _BASES
) -> Steps:
    """Pushes a lever, a spout or a leaf along its arc with closed fingers, from one side of it, at a point of it."""
    now = arm.view.angle(hinge.joint)
    anchor, axis = np.array(hinge.anchor_m), np.array(hinge.axis)
    start = contact_m + _FINGER_M * from_side

    def at(angle_rad: float, T: Array) -> Array:
        there = T.copy()
        there[:3, 3] = anchor + steps.about(axis, angle_rad - now) @ (T[:3, 3] - anchor)
        return there

    ways = []
    for base, tilt, yaw in product(bases, (60.0, 85.0), (-30.0, 0.0, 30.0)):
        direction = steps.tilted(steps.about(UP, np.deg2rad(yaw)) @ AHEAD, np.deg2rad(tilt))
        flat = np.cross(direction, UP)
        for closing in (flat, np.cross(flat, direction)):
            T = steps.tool(start, direction, closing)
            poses = (steps.moved(T, 0.03 * from_side), T, at(to_rad, T))
            ways.append(Way(base=base, poses=poses, joint=hinge.joint, values=(now, now, to_rad)))
    angles = np.linspace(now, to_rad, _SPAN)[1:].tolist()

    def path(way: Way) -> list[Leg]:
        before, T, _ = way.poses
        poses = (steps.backed(before, _BACK_M), before, T, *[at(angle, T) for angle in angles])
        return [Leg(base=way.base, poses=poses, joint=hinge.joint, values=(*[now] * 3, *angles), open_m=0.0)]

    ranked = arm.best(ways, _NUM_WAYS)
    way = ranked[arm.first_free(path(way) for way in ranked)]
    yield from arm.drive(way.base)
    before, T, _ = way.poses
    yield Step(pose=steps.backed(before, _BACK_M), opening=SHUT)
    yield Step(pose=before, opening=SHUT)
    yield Step(pose=T, opening=SHUT, speed_m_s=0.1)
    for angle in angles:
        yield Step(pose=at(angle, T), opening=SHUT, speed_m_s=0.08, holds=hinge.joint, value=angle)
    yield Step(pose=at(to_rad, T), opening=SHUT, wait_steps=20, holds=hinge.joint, value=to_rad)
    yield from steps.retreat(arm.view, opening=SHUT)
