"""Where a hand takes hold of an object as it stands or lies now."""

from __future__ import annotations

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen.handles import ObjectHandle
from dual_system.tasks.kitchen.objects import KINDS
from dual_system.tasks.kitchen.predicates import View
from dual_system.tasks.kitchen.steps import AHEAD, RIGHT, UP, about, tilted, tool

_ROUND_YAWS_RAD = tuple(np.deg2rad((-40.0, 0.0, 40.0)))
_UPRIGHT = 0.7  # cosine of its axis to the vertical, either way up
_LONG_M, _NEARER_M, _FLAT_RAD = 0.035, 0.02, 0.8  # half a length, and how far to this side of its middle
_ABOVE_MIDDLE = 0.2  # of half the height of what has fallen over: fingertips stay clear of what it lies on


def grips_on(view: View, thing: ObjectHandle, tilt_rad: float) -> list[Array]:
    """Returns the tool's poses (4, 4) that grasp an object, tilted about the axis along which the fingers close.

    Round things are grasped from several sides, all others across what is narrow, and long blocks also nearer to the
    robot: the palm of a flat hand would press on their ends.
    """
    body = view.data.body(thing.name)
    R = body.xmat.reshape(3, 3)
    if abs(R[2, 2]) > _UPRIGHT:
        at = body.xpos + R @ [*thing.grasp_m[:2], 0.0] + thing.grasp_m[2] * UP
        across = R @ [np.cos(thing.grasp_yaw_rad), np.sin(thing.grasp_yaw_rad), 0.0]
        closings = [about(UP, yaw) @ RIGHT for yaw in _ROUND_YAWS_RAD] if thing.is_round else [_level(across)]
    else:
        at, closings = body.xpos + _ABOVE_MIDDLE * np.abs(R[2]) @ thing.half_m * UP, [_level(_narrow_axis(R, thing))]
    grips = []
    for closing in closings:
        toward = np.cross(UP, closing)
        toward = -toward if toward @ AHEAD < 0.0 else toward
        is_block = KINDS[thing.kind].shape == "block"  # what is rounded there would slip away
        is_long = is_block and tilt_rad > _FLAT_RAD and float(np.abs(toward @ R) @ thing.half_m) > _LONG_M
        for nearer_m in (0.0, _NEARER_M) if is_long else (0.0,):
            grips.append(tool(at - nearer_m * toward, tilted(toward, tilt_rad), closing))
    return grips


def _narrow_axis(R: Array, thing: ObjectHandle) -> Array:
    """Returns, of the two axes of a body that lie about level, the one along which it is narrower."""
    level = [axis for axis in range(3) if axis != int(np.argmax(np.abs(R[2])))]
    return R[:, min(level, key=lambda axis: thing.half_m[axis])]


def _level(axis: Array) -> Array:
    flat = axis - axis[2] * UP
    return flat / np.linalg.norm(flat)
