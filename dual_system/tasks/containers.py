"""Containers that hide cubes: an upside-down box with a block on its lid to grip it by.

The block reaches down through the lid. A container over a cube therefore rests on the cube, 1.3 mm above the table.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from dual_system.tasks.geometry import Footprint, Spot
from dual_system.tasks.panda import ROBOT_BIT, STIFF_SOLIMP, STIFF_SOLREF, WORLD_BIT
from dual_system.tasks.scene import CUBE_HALF_M, WHITE, SceneFullError, sample_footprint

HIDDEN_HALF_M = CUBE_HALF_M / 1.2  # half the side of a cube that fits under a container
GRIP_Z_M = 0.062  # where the tool closes on the block of a container that stands on the table
EMPTY_Z_M = 0.052  # height of a standing container's origin, the centre of its block
HIDING_Z_M = 2 * HIDDEN_HALF_M + CUBE_HALF_M  # and of one that covers a cube

_INNER_HALF_M, _WALL_HALF_M = 0.025, 0.0025
_LID_HALF_HEIGHT_M, _WALL_HALF_HEIGHT_M = 0.002, 0.025
# Upstream keeps room for one wall's thickness, not for two: the true outer half width is 0.030 m.
_FOOTPRINT_HALF_M = _INNER_HALF_M + _WALL_HALF_M
_YAW_RANGE_RAD = (0.0, np.pi / 2)
_FRICTION = [0.3, 0.005, 0.0001]
_VISIBLE, _UNSEEN = 1, 4  # geom groups
_STUD_RADIUS_M, _STUD_OFFSET_M = 0.002, 0.01
_FOOT_M = 0.0005  # how far feet reach below the walls


def add_container(spec: mujoco.MjSpec, name: str) -> None:
    """Adds a free container; its origin is the centre of the block on its lid, its density 1000 kg/m3 (131 g)."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    reach_m = _INNER_HALF_M + _WALL_HALF_M
    lid = ([0.0, 0.0, -_LID_HALF_HEIGHT_M], [reach_m, reach_m, _LID_HALF_HEIGHT_M])
    wall_z_m = _FOOT_M + _WALL_HALF_HEIGHT_M - EMPTY_Z_M
    boxes = {"block": ([0.0, 0.0, 0.0], [CUBE_HALF_M] * 3), "lid": lid}
    for side in (-1, 1):
        size = [_WALL_HALF_M, reach_m, _WALL_HALF_HEIGHT_M]
        boxes[f"wall_x{side:+d}"] = ([side * reach_m, 0.0, wall_z_m], size)
        boxes[f"wall_y{side:+d}"] = ([0.0, side * reach_m, wall_z_m], [size[1], size[0], size[2]])
    for part, (center_m, half_m) in boxes.items():
        body.add_geom(
            name=f"{name}/{part}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=center_m,
            size=half_m,
            density=1000.0,
            rgba=WHITE,
            group=_VISIBLE,
            **_solid(0 if part == "block" else WORLD_BIT),
        )
    # It stands on four feet, a quarter of the contacts that four walls would make. And the block touches the robot
    # alone and rests on hidden cubes by four studs: where a square lies centred on a smaller, turned one, MuJoCo 3.9
    # stops with a fatal error, because its box-box collider finds nine contacts and has room for eight.
    for offset_m, lowest_m in ((reach_m, -EMPTY_Z_M), (_STUD_OFFSET_M, -CUBE_HALF_M)):
        for x_sign, y_sign in itertools.product((-1, 1), repeat=2):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=[x_sign * offset_m, y_sign * offset_m, lowest_m + _STUD_RADIUS_M],
                size=[_STUD_RADIUS_M, 0.0, 0.0],
                mass=0.0,
                group=_UNSEEN,
                **_solid(WORLD_BIT),
            )


def draw_spots(
    rng: np.random.Generator,
    centers_m: Sequence[tuple[float, float]],
    *,
    half_m: float,
    obstacles: Sequence[Footprint],
    gap_m: float,
) -> tuple[Spot, ...]:
    """Draws one container's place in the square of ``half_m`` around each centre, ``gap_m`` from all before it.

    It ends with the first that finds no room, as upstream's does: the result may be shorter than ``centers_m``.
    """
    taken = list(obstacles)
    reach_m = half_m - _FOOTPRINT_HALF_M
    spots = []
    for center_m in centers_m:
        try:
            drawn = sample_footprint(
                rng,
                center_m=center_m,
                reach_m=(reach_m, reach_m),
                half_m=(_FOOTPRINT_HALF_M, _FOOTPRINT_HALF_M),
                yaw_range_rad=_YAW_RANGE_RAD,
                obstacles=taken,
                gap_m=gap_m,
            )
        except SceneFullError:
            break
        taken.append(drawn)
        spots.append(Spot(x_m=drawn.center_m[0], y_m=drawn.center_m[1], yaw_rad=drawn.yaw_rad))
    return tuple(spots)


def _solid(world_bit: int) -> dict[str, Any]:
    return {
        "contype": world_bit,
        "conaffinity": world_bit | ROBOT_BIT,
        "friction": _FRICTION,
        "condim": 4,
        "solref": STIFF_SOLREF,
        "solimp": STIFF_SOLIMP,
    }
