"""Rigid poses, screws and oriented rectangles, in plain numpy.

A pose is (7,) float64: xyz in metres, then a unit quaternion wxyz. A transform is the same thing as a (4, 4) matrix.
World frame: +x forward from the robot, +y the robot's left, +z up, table top at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def pose(x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0) -> Array:
    """Returns the pose (7,) at a point, turned by ``yaw_rad`` about the vertical."""
    return np.array([x_m, y_m, z_m, np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])


def transform(pose_7: Array) -> Array:
    """Returns the (4, 4) transform of a pose (7,)."""
    T = np.eye(4)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(pose_7[3:], dtype=np.float64))
    T[:3, :3] = rotation.reshape(3, 3)
    T[:3, 3] = pose_7[:3]
    return T


def pose_of(T: Array) -> Array:
    """Returns the pose (7,) of a (4, 4) transform: the inverse of `transform`, with qw >= 0."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, T[:3, :3].ravel())
    return np.concatenate([T[:3, 3], quat if quat[0] >= 0 else -quat])


def skew(v: Array) -> Array:
    """Returns the (3, 3) matrix of the cross product with ``v`` (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation_log(R: Array) -> Array:
    """Returns the rotation vector (3,) in radians of a rotation matrix (3, 3); its angle is at most pi."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, R.ravel())
    velocity = np.empty(3)
    mujoco.mju_quat2Vel(velocity, quat, 1.0)
    return velocity


def screw_log(T: Array) -> Array:
    """Returns the twist (6,) = (v, w) of a transform (4, 4): `screw_exp` of it gives the transform back."""
    w = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(w))
    if angle < 1e-9:
        return np.concatenate([T[:3, 3], w])
    W = skew(w)
    half = angle / 2
    V_inverse = np.eye(3) - W / 2 + (1 - half / np.tan(half)) / angle**2 * (W @ W)
    return np.concatenate([V_inverse @ T[:3, 3], w])


def screw_exp(twist: Array) -> Array:
    """Returns the transform (4, 4) reached by moving along a constant twist (6,) = (v, w) for unit time."""
    v, w = twist[:3], twist[3:]
    angle = float(np.linalg.norm(w))
    T = np.eye(4)
    if angle < 1e-9:
        T[:3, 3] = v
        return T
    W = skew(w)
    sin_term, cos_term = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    T[:3, :3] = np.eye(3) + sin_term * W + cos_term * (W @ W)
    T[:3, 3] = v + cos_term * (W @ v) + (1 - sin_term) / angle**2 * (W @ (W @ v))
    return T


def smoothstep(fraction: float) -> float:
    """Returns how far a motion from rest to rest has come, 0 to 1, after a fraction of its time in [0, 1]."""
    return fraction * fraction * (3.0 - 2.0 * fraction)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """Where something stands on the table, and how it is turned."""

    x_m: float
    y_m: float
    yaw_rad: float = 0.0

    @property
    def xy_m(self) -> tuple[float, float]:
        """The place without the turn."""
        return self.x_m, self.y_m

    def pose(self, z_m: float) -> Array:
        """The pose (7,) of something upright here, its origin at a height."""
        return pose(self.x_m, self.y_m, z_m, self.yaw_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class Footprint:
    """The rectangle an object covers on the table."""

    center_m: tuple[float, float]
    half_m: tuple[float, float]
    yaw_rad: float = 0.0

    def axes(self) -> Array:
        """Returns the rectangle's two unit axes as rows (2, 2)."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, s], [-s, c]])


def distance_m(point_m: tuple[float, float], footprint: Footprint) -> float:
    """Returns how far a point on the table lies outside a rectangle; 0 inside."""
    local = footprint.axes() @ np.subtract(point_m, footprint.center_m)
    return float(np.linalg.norm(np.maximum(np.abs(local) - footprint.half_m, 0.0)))


def is_clear(a: Footprint, b: Footprint, gap_m: float) -> bool:
    """True if some side direction of either rectangle separates the two by at least ``gap_m``.

    That is the separating-axis test with a margin; corner to corner, the true distance may exceed the gap it sees.
    """
    between = np.subtract(b.center_m, a.center_m)
    axes = np.concatenate([a.axes(), b.axes()])  # (4, 2)
    reach_a = np.abs(axes @ a.axes().T) @ a.half_m
    reach_b = np.abs(axes @ b.axes().T) @ b.half_m
    return bool(np.any(np.abs(axes @ between) >= reach_a + reach_b + gap_m))
