"""Draws the places of the button, cubes and targets of one episode, without overlap.

The order of the draws is part of a task: change it, and every seed gives another scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from dual_system.tasks.geometry import Footprint, distance_m, is_clear, pose
from dual_system.tasks.panda import BASE_POSITION_M
from dual_system.tasks.physics import Physics
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS, CUBE_HALF_M, SceneFullError, sample_footprint

DrawnT = TypeVar("DrawnT")
Point = tuple[float, float]
Disc = tuple[Point, float]  # centre and radius

BUTTON_ROOM_HALF_M = (1.5 * BUTTON_HALF_M[0], 1.5 * BUTTON_HALF_M[1])  # what upstream keeps free for the fingers
_REACH_M = 0.79  # from the arm's base; measured: no gripper that points down gets further than 0.80
_OPEN_HAND_HALF_M = (0.06, 0.012)  # what open fingers cover of the table when they come down about a cube
_TRIANGLE_M = ((-0.05, -0.1), (-0.05, 0.1), (0.1, 0.0))
_LINE_M = ((0.0, -0.15), (0.0, 0.15), (0.0, 0.0))
_BUTTON_CENTER_M: Point = (-0.2, 0.0)
_BUTTON_REACH_M: Point = (0.05, 0.2)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedCube:
    """One cube of the scene."""

    x_m: float
    y_m: float
    yaw_rad: float
    color: str

    @property
    def footprint(self) -> Footprint:
        """The area that it covers on the table."""
        return Footprint(center_m=(self.x_m, self.y_m), half_m=(CUBE_HALF_M, CUBE_HALF_M), yaw_rad=self.yaw_rad)

    def put(self, physics: Physics, name: str) -> None:
        """Places and paints a cube prop as this one."""
        physics.place(name, pose(self.x_m, self.y_m, CUBE_HALF_M, self.yaw_rad))
        physics.paint(name, CUBE_COLORS[self.color])


def until_it_fits(draw: Callable[[], DrawnT]) -> DrawnT:
    """Draws whole scenes until one has room for everything; a crowded draw can leave none for the last prop."""
    while True:
        try:
            return draw()
        except SceneFullError:
            continue


def draw_button(
    rng: np.random.Generator,
    *,
    center_m: Point = _BUTTON_CENTER_M,
    reach_m: Point = _BUTTON_REACH_M,
    half_m: Point = BUTTON_HALF_M,
) -> Footprint:
    """Draws the button's place, its centre uniform in ``center_m`` +- ``reach_m``; by default beside the robot.

    ``half_m`` is what others shall keep away from.
    """
    return sample_footprint(
        rng,
        center_m=center_m,
        reach_m=reach_m,
        half_m=half_m,
        yaw_range_rad=(0.0, 0.0),
        obstacles=(),
        gap_m=0.0,
    )


def draw_threesome(rng: np.random.Generator) -> tuple[Point, ...]:
    """Draws the three points around which objects are scattered: on a triangle or a line, not yet rotated."""
    return (_TRIANGLE_M, _LINE_M)[int(rng.integers(2))]


def turned_at_random(rng: np.random.Generator, points_m: Sequence[Point]) -> list[Point]:
    """Turns points about the origin, all by one angle drawn uniformly."""
    c, s = np.cos(angle_rad := rng.uniform(0.0, 2 * np.pi)), np.sin(angle_rad)
    return [(float(c * x - s * y), float(s * x + c * y)) for x, y in points_m]


def draw_cube(
    rng: np.random.Generator,
    color: str,
    *,
    center_m: Point,
    half_m: Point,
    obstacles: Sequence[Footprint],
    gap_m: float,
) -> PlacedCube:
    """Draws a cube, whole within the rectangle ``center_m`` +- ``half_m`` and ``gap_m`` from all obstacles."""
    spot = sample_footprint(
        rng,
        center_m=center_m,
        reach_m=(half_m[0] - CUBE_HALF_M, half_m[1] - CUBE_HALF_M),
        half_m=(CUBE_HALF_M, CUBE_HALF_M),
        yaw_range_rad=(0.0, 2 * np.pi),
        obstacles=obstacles,
        gap_m=gap_m,
    )
    return PlacedCube(x_m=spot.center_m[0], y_m=spot.center_m[1], yaw_rad=spot.yaw_rad, color=color)


def is_in_reach(xy_m: Point) -> bool:
    """True if the arm can pick up and put down at a point."""
    return bool(np.hypot(*np.subtract(xy_m, BASE_POSITION_M[:2])) <= _REACH_M)


def has_finger_room(cube: PlacedCube, others: Iterable[PlacedCube]) -> bool:
    """True if open fingers can come down about the cube in one direction or the other without touching other cubes."""
    hands = [
        Footprint(center_m=(cube.x_m, cube.y_m), half_m=_OPEN_HAND_HALF_M, yaw_rad=cube.yaw_rad + turn_rad)
        for turn_rad in (0.0, np.pi / 2)
    ]
    obstacles = [other.footprint for other in others]
    return any(all(is_clear(hand, obstacle, 0.0) for obstacle in obstacles) for hand in hands)


def draw_disc(
    rng: np.random.Generator,
    *,
    radius_m: float,
    center_m: Point,
    half_m: Point,
    obstacles: Sequence[Footprint],
    gap_m: float,
    discs: Sequence[Disc] = (),
    max_tries: int = 256,
) -> Point:
    """Draws the centre of a disc, whole within ``center_m`` +- ``half_m`` and ``gap_m`` from all obstacles and discs.

    Raises SceneFullError after ``max_tries`` draws that all met an obstacle.
    """
    low = np.subtract(center_m, half_m) + radius_m
    high = np.add(center_m, half_m) - radius_m
    for _ in range(max_tries):
        x_m, y_m = rng.uniform(low, high)
        near = any(distance_m((x_m, y_m), obstacle) < radius_m + gap_m for obstacle in obstacles)
        if not near and all(np.hypot(x_m - x, y_m - y) >= radius_m + gap_m + other_m for (x, y), other_m in discs):
            return float(x_m), float(y_m)
    raise SceneFullError(
        f"no free place for a disc of radius {radius_m:.3f} m after {max_tries} tries: {len(obstacles) + len(discs)} "
        f"obstacles within {half_m} m of {center_m}, gap {gap_m} m. Draw the scene again."
    )
