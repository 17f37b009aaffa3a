"""Where the tool is, as transforms (4, 4): its palm facing down, at a height, at a place, on ways that carry a body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_system.tasks.geometry import Array

LEFT = np.array([0.0, 1.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])
_MIDDLE_M = (-0.15, 0.0, 0.25)  # from here the arm gets nearly everywhere
OVER_M, _OVER_COS, OVER_Z_M = 0.01, 0.98, 0.02  # of the tool over a grasp: aside, turned (11 degrees), in height


def facing_down(closing: Array) -> Array:
    """A transform (4, 4) at the origin with the palm facing down and the fingers closing along a direction (3,)."""
    y = closing * [1.0, 1.0, 0.0]
    y = y / np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([np.cross(y, DOWN), y, DOWN])
    return T


def is_over(tool: Array, above: Array, grasp_z_m: float) -> bool:
    """Whether a tool (4, 4) is on the straight way down from its waiting pose above an object."""
    aside_m = np.linalg.norm(tool[:2, 3] - above[:2, 3])
    is_between = grasp_z_m - OVER_Z_M < tool[2, 3] < above[2, 3] + OVER_Z_M
    return bool(aside_m < OVER_M and is_between and tool[:3, 1] @ above[:3, 1] > _OVER_COS)


def at_height(T: Array, z_m: float) -> Array:
    """The same at another height."""
    moved = T.copy()
    moved[2, 3] = z_m
    return moved


def put_at(T: Array, x_m: float, y_m: float, z_m: float) -> Array:
    """The transform with the same rotation at another place."""
    moved = T.copy()
    moved[:3, 3] = x_m, y_m, z_m
    return moved


def lying_along(along: Array) -> Array:
    """A transform (4, 4) at the origin, upright and with its x axis along a horizontal unit direction (3,)."""
    T = np.eye(4)
    T[:3, :3] = np.column_stack([along, np.cross(-DOWN, along), -DOWN])
    return T


def ways_of_carrying(body: Array, tool: Array, poses: Sequence[Array]) -> list[list[Array]]:
    """Tool poses (4, 4) that bring a held body to poses (4, 4): directly, or through the middle."""
    targets = [pose @ np.linalg.inv(body) @ tool for pose in poses]
    if not targets:
        return [[]]
    detours: tuple[list[Array], ...] = ([], [put_at(targets[0], *_MIDDLE_M)], [put_at(facing_down(-LEFT), *_MIDDLE_M)])
    return [[*detour, *targets] for detour in detours]
