"""What a hand does, as waypoints that any robot can follow: the primitives of the scripts.

A step says where the tool goes in the world, how far the fingers are open, and what moves with the hand meanwhile. The
Panda follows it with its controller and real contacts; a puppet is put there and takes along what it holds.
The tool's point is the site `grip_site`, its axes are those of the body `right_hand`: z leaves the palm, the fingers
open along y. (robosuite's site itself is turned by a quarter.)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dual_system.tasks.geometry import Array, rotation_log
from dual_system.tasks.kitchen.handles import Hinge, Knob, Slide
from dual_system.tasks.kitchen.predicates import GRIP_SITE, HAND, View

OPEN, SHUT = 1.0, 0.0
UP, AHEAD, RIGHT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])

FREE_M_S, SWING_M_S, TOUCHING_M_S = 0.30, 0.22, 0.12  # speeds of the tool
_GRIP_STEPS = 8  # control steps in which fingers close
_SWING_POINTS = 6
_BACK_M, _UP_M = 0.10, 0.15
_SIDEWAYS_M = 0.03  # less is no way around


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One straight motion of the tool, or of the base under it, and what comes along."""

    pose: Array  # (4, 4) of the tool in the world, at the end of it
    opening: float = OPEN
    speed_m_s: float = FREE_M_S
    wait_steps: int = 0  # control steps to stay there
    holds: str = ""  # the object or joint that moves with the hand
    value: float | None = None  # of that joint at the end
    base_m: tuple[float, float] | None = None  # where the base stands then, ahead and left of its stand; None: as it is


Steps = Iterator[Step]


def tool(position_m: Sequence[float] | Array, direction: Array, closing: Array) -> Array:
    """Returns the tool's pose (4, 4) at a point, pointing in a direction, its fingers closing along another."""
    z = direction / np.linalg.norm(direction)
    y = closing - z * (closing @ z)
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = position_m
    return T


def flipped(T: Array) -> Array:
    """Returns the pose in which the two fingers have changed places."""
    there = T.copy()
    there[:3, :2] *= -1.0
    return there


def tilted(toward: Array, tilt_rad: float) -> Array:
    """Returns the direction (3,) of a hand that comes from above, tilted so that it points towards a horizontal one."""
    return np.sin(tilt_rad) * toward - np.cos(tilt_rad) * UP


def moved(T: Array, by_m: Sequence[float] | Array) -> Array:
    """Returns a pose shifted in the world."""
    there = T.copy()
    there[:3, 3] += by_m
    return there


def between(T: Array, there: Array, num: int = 2) -> list[Array]:
    """Returns poses on the straight way from one to another, without its ends."""
    turn = rotation_log(there[:3, :3] @ T[:3, :3].T)
    angle = float(np.linalg.norm(turn))
    poses = []
    for share in np.linspace(0.0, 1.0, num + 2)[1:-1]:
        pose = T.copy()
        pose[:3, 3] += share * (there[:3, 3] - T[:3, 3])
        if angle > 1e-9:
            pose[:3, :3] = about(turn / angle, share * angle) @ T[:3, :3]
        poses.append(pose)
    return poses


def around(T: Array, there: Array) -> list[Array]:
    """Returns the corners of a way to another pose that goes sideways only where it is nearest to the robot.

    Fixtures are ahead: the hand first comes back to where the nearer of both ends is, and goes ahead last.
    """
    if abs(there[0, 3] - T[0, 3]) < _SIDEWAYS_M:
        return []
    near_m = min(T[1, 3], there[1, 3])
    corners = [moved(each, (near_m - each[1, 3]) * AHEAD) for each in (T, there)]
    return [corner for corner, end in zip(corners, (T, there), strict=True) if end[1, 3] - near_m > _SIDEWAYS_M]


def backed(T: Array, by_m: float) -> Array:
    """Returns a pose drawn back along the direction in which the tool points."""
    return moved(T, -by_m * T[:3, 2])


def here(view: View) -> Array:
    """Returns the tool's pose (4, 4) now."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = view.data.body(HAND).xmat.reshape(3, 3), view.data.site(GRIP_SITE).xpos
    return T


def reach(T: Array, opening: float, *, back_m: float = _BACK_M, above_m: float = 0.0) -> Steps:
    """Goes to a pose from behind or above it."""
    yield Step(pose=moved(backed(T, back_m), above_m * UP), opening=opening)
    yield Step(pose=T, opening=opening, speed_m_s=TOUCHING_M_S)


def grasp(T: Array, holds: str, *, above_m: float = 0.0) -> Steps:
    """Reaches a pose with open fingers and closes them."""
    yield from reach(T, OPEN, above_m=above_m)
    yield Step(pose=T, opening=SHUT, wait_steps=_GRIP_STEPS, holds=holds)


def release(T: Array) -> Steps:
    """Opens the fingers."""
    yield Step(pose=T, opening=OPEN, wait_steps=_GRIP_STEPS)


def retreat(view: View, *, back_m: float = 0.12, up_m: float = 0.0, opening: float = OPEN) -> Steps:
    """Draws the hand back and up."""
    T = backed(here(view), back_m)
    yield Step(pose=T, opening=opening, speed_m_s=0.2)
    if up_m:
        yield Step(pose=moved(T, up_m * UP), opening=opening)


def press(T: Array) -> Steps:
    """Presses what is at a pose, with closed fingers, to a centimetre past contact, and withdraws."""
    yield Step(pose=backed(T, 0.12), opening=SHUT)
    yield Step(pose=backed(T, 0.05), opening=SHUT)
    inside = backed(T, -0.01)
    yield Step(pose=inside, opening=SHUT, speed_m_s=0.08, wait_steps=4)
    yield Step(pose=backed(T, 0.2), opening=SHUT)


def swing(hinge: Hinge, from_rad: float, to_rad: float, frame: Array, *, follow: float, opening: float = SHUT) -> Steps:
    """Leads a leaf's handle along its arc; ``frame`` is the tool at the start, which turns along by a share."""
    grip_0, _, _ = hinge.at(from_rad)
    offset = frame[:3, 3] - grip_0
    axis = np.array(hinge.axis)
    for angle in np.linspace(from_rad, to_rad, _SWING_POINTS + 1)[1:]:
        turned = about(axis, follow * (angle - from_rad))
        T = np.eye(4)
        T[:3, :3] = turned @ frame[:3, :3]
        T[:3, 3] = hinge.at(angle)[0] + turned @ offset
        yield Step(pose=T, opening=opening, speed_m_s=SWING_M_S, holds=hinge.joint, value=float(angle))


def slide(drawer: Slide, from_m: float, to_m: float, frame: Array, *, opening: float = SHUT) -> Steps:
    """Leads a drawer along its axis; ``frame`` is the tool at the start."""
    there = moved(frame, (to_m - from_m) * np.array(drawer.axis))
    yield Step(pose=there, opening=opening, speed_m_s=SWING_M_S, holds=drawer.joint, value=to_m)


def turn(knob: Knob, frame: Array, from_rad: float, to_rad: float) -> Steps:
    """Turns a gripped knob by the wrist."""
    for angle in np.linspace(from_rad, to_rad, 5)[1:]:
        T = frame.copy()
        T[:3, :3] = about(np.array(knob.axis), angle - from_rad) @ frame[:3, :3]
        yield Step(pose=T, opening=SHUT, speed_m_s=TOUCHING_M_S, holds=knob.joint, value=float(angle))


def rotated_about_itself(T: Array, angle_rad: float) -> Array:
    """Returns a pose turned about the direction in which the tool points."""
    there = T.copy()
    there[:3, :3] = about(T[:3, 2], angle_rad) @ T[:3, :3]
    return there


def about(axis: Array, angle_rad: float) -> Array:
    """Returns the rotation (3, 3) about a unit axis."""
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + np.sin(angle_rad) * K + (1.0 - np.cos(angle_rad)) * K @ K
