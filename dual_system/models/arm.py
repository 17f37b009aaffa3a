"""The Panda arm in numpy: forward kinematics, Jacobian and inverse kinematics, for POUNCE's `action_space`.

The constants are Franka's, equal to those of the simulator's scene (a test compares them); no simulator is needed.
Frame: the table's, +x forward from the robot, +z up; the robot's base is at x = -0.615 m. The tool point is a fixed
point of the hand, between the fingers of RoboMME's gripper, whatever tool the hand carries.
"""

# ... any number of leading dims, R rotation matrices

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NUM_ARM_JOINTS = 7
JOINT_LOW_RAD = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
JOINT_HIGH_RAD = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
TOOL_DOWN = np.diag([1.0, -1.0, -1.0])
"""The tool's rotation while it points straight down and is not turned."""

_BASE_M = (-0.615, 0.0, 0.0)
_LINKS = (  # each joint in the previous joint's frame: position (m), quarter turns about x; its own axis is z
    ((0.0, 0.0, 0.333), 0),
    ((0.0, 0.0, 0.0), -1),
    ((0.0, -0.316, 0.0), 1),
    ((0.0825, 0.0, 0.0), 1),
    ((-0.0825, 0.384, 0.0), -1),
    ((0.0, 0.0, 0.0), 1),
    ((0.088, 0.0, 0.0), 1),
)
_TOOL_FROM_LINK7_M = 0.107 + 0.1034  # the flange, then RoboMME's tool point
_HAND_TURN_RAD = -np.pi / 4

_DAMPING = 1e-4
_MAX_ITERATIONS = 6
_MAX_STEP_RAD = 0.3  # norm of one iteration's step: near a stretched arm the linearisation overshoots
_LEVER_M = 0.1  # position error that weighs as much as a rotation error of one radian
_POSITION_TOLERANCE_M, _ROTATION_TOLERANCE_RAD = 1e-5, 1e-4
_SMALL_RAD = 1e-9


class Poses(NamedTuple):
    """Tool poses in the table's frame."""

    position_m: Array
    """(..., 3)"""
    rotation: Array
    """(..., 3, 3)"""


def tool_poses(joints_rad: ArrayLike) -> Poses:
    """Returns the tool's poses at joint angles (..., 7); 10^5 rows take about a second."""
    tool = _frames(np.asarray(joints_rad, dtype=np.float64))[-1]
    return Poses(tool[..., :3, 3], tool[..., :3, :3])


def tool_jacobian(joints_rad: ArrayLike) -> Array:
    """Returns d(tool)/d(joints) (6, 7) at joint angles (7,): linear rows, then angular, both in the table's frame."""
    return _jacobian(np.array(_frames(np.asarray(joints_rad, dtype=np.float64))))


def joints_near(target: Poses, start_rad: Array) -> Array:
    """Returns joint angles (7,) near ``start_rad`` (7,), within the limits, that bring the tool to one pose.

    Damped least squares takes the shortest steps in joint space, so the rows of a chunk, each started from the previous
    row's solution, make a smooth path. A joint that meets a limit stays there while the others move on. Never raises:
    for a pose out of reach it returns the nearest iterate.
    """
    joints = start_rad.clip(JOINT_LOW_RAD, JOINT_HIGH_RAD)
    nearest, least = joints, np.inf
    is_free = np.ones(NUM_ARM_JOINTS)
    for _ in range(_MAX_ITERATIONS):
        frames = np.array(_frames(joints))
        move, turn = target.position_m - frames[-1, :3, 3], _turn(target.rotation @ frames[-1, :3, :3].T)
        error = np.concatenate([move, turn])
        distance = float(move @ move) / _LEVER_M**2 + float(turn @ turn)
        if not distance >= least:  # lets NaN through: the limit check before the robot rejects it
            nearest, least = joints, distance
        if max(abs(move)) < _POSITION_TOLERANCE_M and max(abs(turn)) < _ROTATION_TOLERANCE_RAD:
            break
        J = _jacobian(frames) * is_free
        step = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), error)
        wanted = joints + step * min(1.0, _MAX_STEP_RAD / max(math.sqrt(step @ step), _SMALL_RAD))
        joints = wanted.clip(JOINT_LOW_RAD, JOINT_HIGH_RAD)
        is_free = is_free * (joints == wanted)
    return nearest


def rotation_vectors(R: Array) -> Array:
    """Returns the rotation vectors (..., 3) in radians of rotations (..., 3, 3); their angles are at most pi."""
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    # 4 q q^T of the quaternion q = (w, x, y, z). Every row is q up to scale; the longest is numerically the best.
    rows = (
        (1 + xx + yy + zz, x, y, z),
        (x, 1 + xx - yy - zz, xy, xz),
        (y, xy, 1 - xx + yy - zz, yz),
        (z, xz, yz, 1 - xx - yy + zz),
    )
    products = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    longest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(products, longest[..., None, None], axis=-2)[..., 0, :]
    q = q * np.where(q[..., :1] < 0, -1.0, 1.0) / np.linalg.norm(q, axis=-1, keepdims=True)
    sin_half = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    is_turned = sin_half > _SMALL_RAD
    angle = 2 * np.arctan2(sin_half, q[..., :1])
    return q[..., 1:] * np.where(is_turned, angle / np.where(is_turned, sin_half, 1.0), 2.0)


def _turn(R: Array) -> Array:
    """Scalar `rotation_vectors`: (3, 3) -> (3,), five times as fast below a quarter turn."""
    cos = (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    if not cos > 0:
        return rotation_vectors(R)
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sin = math.sqrt(x * x + y * y + z * z) / 2
    return np.array([x, y, z]) * (math.atan2(sin, cos) / sin / 2 if sin > _SMALL_RAD else 0.5)


def rotations(vectors_rad: Array) -> Array:
    """Returns the rotations (..., 3, 3) of rotation vectors (..., 3): the inverse of `rotation_vectors`."""
    angle = np.linalg.norm(vectors_rad, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors_rad, -1, 0)
    zero = np.zeros_like(x)
    W = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    # sinc is smooth at 0, and 1 - cos a = 2 sin^2(a/2).
    first, second = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    return np.eye(3) + first * W + second * (W @ W)


def _turned(axis: int, angle_rad: float) -> Array:
    """Homogeneous rotation (4, 4) about a coordinate axis."""
    vector = np.zeros(3)
    vector[axis] = angle_rad
    T = np.eye(4)
    T[:3, :3] = rotations(vector)
    return T


def _placed(place_m: tuple[float, float, float], quarters: int) -> Array:
    """Homogeneous transform (4, 4): a translation and quarter turns about x."""
    T = _turned(0, quarters * np.pi / 2)
    T[:3, 3] = place_m
    return T


_BASE = _placed(_BASE_M, 0)
_JOINTS = np.array([_placed(place_m, quarters) for place_m, quarters in _LINKS])  # (7, 4, 4) at angle 0
_TOOL = _placed((0.0, 0.0, _TOOL_FROM_LINK7_M), 0) @ _turned(2, _HAND_TURN_RAD)


def _frames(joints_rad: Array) -> list[Array]:
    """The frames (..., 4, 4) that turn with joints 1 to 7, then the tool's, at joint angles (..., 7)."""
    c, s = np.cos(joints_rad)[..., None], np.sin(joints_rad)[..., None]
    links = np.empty((*joints_rad.shape, 4, 4))
    links[...] = _JOINTS
    links[..., 0] = c * _JOINTS[:, :, 0] + s * _JOINTS[:, :, 1]
    links[..., 1] = c * _JOINTS[:, :, 1] - s * _JOINTS[:, :, 0]
    frames, frame = [], _BASE
    for joint in range(NUM_ARM_JOINTS):
        frame = frame @ links[..., joint, :, :]
        frames.append(frame)
    return [*frames, frame @ _TOOL]


def _jacobian(frames: Array) -> Array:
    """Jacobian (6, 7) from `_frames` (8, 4, 4): each joint turns the tool about its own z axis."""
    axes, arms = frames[:-1, :3, 2].T, (frames[-1, :3, 3] - frames[:-1, :3, 3]).T
    x, y, z = axes
    ax, ay, az = arms
    return np.array([y * az - z * ay, z * ax - x * az, x * ay - y * ax, x, y, z])
