"""Pegs, and the box they fit into: a bar of two halves, head and tail, and a block with a square hole through it.

Each half of a peg is a body of its own, so that one end can be seen, grasped and judged apart from the other.
"""

from __future__ import annotations

from typing import Any

import mujoco

from dual_system.tasks.geometry import Footprint, Spot
from dual_system.tasks.panda import ROBOT_BIT, STIFF_SOLIMP, STIFF_SOLREF, WORLD_BIT
from dual_system.tasks.scene import RGBA

PEG_HALF_WIDTH_M = 0.01
BOX_HALF_M = (0.05, 0.04)  # along the hole and across it
BOX_Z_M = 0.04  # height of a standing box's origin, its centre
BOX_RGBA: RGBA = (1, 210 / 255, 137 / 255, 1)

_DENSITY = 1200.0
_TOUCHED = 0.9  # of a half's length; upstream's halves do not touch each other either
_HOLE_HALF_M, _OUTER_HALF_M = 0.017, 0.04
_CORE_RADIUS_M, _CORE_HALF_M, _CORE_BELOW_M = 0.015, 0.055, 0.01
_FRICTION = [0.3, 0.005, 0.0001]
_VISIBLE, _UNSEEN = 1, 4  # geom groups


def add_peg(spec: mujoco.MjSpec, name: str, half_length_m: float, rgba: RGBA) -> None:
    """Adds a free peg along its own x axis; its origin is its centre.

    ``name/head`` is the half towards +x, ``name/tail`` the other one: bodies, and the geoms to paint.
    """
    peg = spec.worldbody.add_body(name=name)
    peg.add_freejoint(name=name)
    reach_m = half_length_m / 2
    for end, side in (("head", 1.0), ("tail", -1.0)):
        half = peg.add_body(name=f"{name}/{end}", pos=[side * reach_m, 0.0, 0.0])
        half.add_geom(
            name=f"{name}/{end}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[reach_m, PEG_HALF_WIDTH_M, PEG_HALF_WIDTH_M],
            rgba=rgba,
            mass=0.0,
            contype=0,
            conaffinity=0,
            group=_VISIBLE,
        )
        half.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[_TOUCHED * reach_m, PEG_HALF_WIDTH_M, PEG_HALF_WIDTH_M],
            density=_DENSITY,
            condim=4,
            group=_UNSEEN,
            **_solid(),
        )


def add_box_with_hole(spec: mujoco.MjSpec, name: str) -> None:
    """Adds a box that nothing moves, with a hole through it along its own x axis; its origin is its centre.

    ``name/core`` is an upright cylinder within, only seen, which stands out at the top: the lamp that shows a peg in.
    """
    box = spec.worldbody.add_body(name=name, mocap=True)
    wall_half_m = (_OUTER_HALF_M - _HOLE_HALF_M) / 2
    offset_m = _HOLE_HALF_M + wall_half_m
    for side in (1, -1):
        for pos, size in (
            ([0.0, side * offset_m, 0.0], [BOX_HALF_M[0], wall_half_m, _OUTER_HALF_M]),
            ([0.0, 0.0, side * offset_m], [BOX_HALF_M[0], _OUTER_HALF_M, wall_half_m]),
        ):
            box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size, rgba=BOX_RGBA, group=_VISIBLE, **_solid())
    core = box.add_body(name=f"{name}/core", pos=[0.0, 0.0, -_CORE_BELOW_M])
    core.add_geom(
        name=f"{name}/core",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[_CORE_RADIUS_M, _CORE_HALF_M, 0.0],
        rgba=BOX_RGBA,
        contype=0,
        conaffinity=0,
        group=_VISIBLE,
    )


def peg_footprint(spot: Spot, half_length_m: float) -> Footprint:
    """Returns what a lying peg covers of the table."""
    return Footprint(center_m=spot.xy_m, half_m=(half_length_m, PEG_HALF_WIDTH_M), yaw_rad=spot.yaw_rad)


def _solid() -> dict[str, Any]:
    return {
        "contype": WORLD_BIT,
        "conaffinity": WORLD_BIT | ROBOT_BIT,
        "friction": _FRICTION,
        "solref": STIFF_SOLREF,
        "solimp": STIFF_SOLIMP,
    }
