"""Props of the memory tasks, beyond the cube, button and disc of `scene`: ringed targets, the bin, ghosts."""

from __future__ import annotations

from typing import Any

import mujoco

from dual_system.tasks.panda import ROBOT_BIT, STIFF_SOLIMP, STIFF_SOLREF, WORLD_BIT
from dual_system.tasks.scene import RGBA, WHITE, display_rgba

TARGET_RADIUS_M = 0.04
TARGET_THICKNESS_M = 0.005
# Upstream hands these display values to its renderer as linear light, so that they come out paler than they read.
PURPLE: RGBA = display_rgba((160 / 255, 32 / 255, 240 / 255, 1))
GRAY: RGBA = display_rgba((128 / 255, 128 / 255, 128 / 255, 1))
RED: RGBA = (1, 0, 0, 1)

BIN_HALF_M = (0.05, 0.05)
BIN_HEIGHT_M = 0.05
_BIN_WALL_HALF_M = 0.005
_VISIBLE = 1  # geom group that the cameras see
NUM_RINGS = 5
_RING_RISE_M = 1e-5  # each inner ring stands out by this much; flush ones would flicker


def add_target(
    spec: mujoco.MjSpec,
    name: str,
    rgba: RGBA,
    *,
    radius_m: float = TARGET_RADIUS_M,
    half_height_m: float = TARGET_THICKNESS_M / 2,
) -> None:
    """Adds five concentric rings, coloured and white by turns, that are only seen; the origin is their centre."""
    add_rings(spec.worldbody.add_body(name=name, mocap=True), name, rgba, radius_m, half_height_m)


def add_rings(
    body: mujoco.MjsBody, prefix: str, rgba: RGBA, radius_m: float, half_height_m: float, z_m: float = 0.0
) -> None:
    """Adds a target's rings to a body, ``prefix``/0 the outermost and /4 the innermost, their centre at a height."""
    for ring in range(NUM_RINGS):
        body.add_geom(
            name=f"{prefix}/{ring}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius_m * (1 - ring / NUM_RINGS), half_height_m + ring * _RING_RISE_M, 0.0],
            pos=[0.0, 0.0, z_m],
            rgba=WHITE if ring % 2 else rgba,
            **_seen_only(),
        )


def add_block(spec: mujoco.MjSpec, name: str, half_m: tuple[float, float, float]) -> None:
    """Adds a box that stands where it is placed, whatever runs into it. Its origin is its centre."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half_m, **_solid())


def add_dot(spec: mujoco.MjSpec, name: str, radius_m: float) -> None:
    """Adds a white ball that is only seen."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius_m, 0.0, 0.0], rgba=WHITE, **_seen_only())


def add_bin(spec: mujoco.MjSpec, name: str) -> None:
    """Adds a square bin, open above and below; its origin is the centre, 25 mm above the table.

    The black floor half way up is only seen: what falls in lands on the table.
    """
    body = spec.worldbody.add_body(name=name, mocap=True)
    half_height_m = BIN_HEIGHT_M / 2
    offset_m = BIN_HALF_M[0] - _BIN_WALL_HALF_M
    inner_m = BIN_HALF_M[0] - 2 * _BIN_WALL_HALF_M
    along_x = [BIN_HALF_M[0], _BIN_WALL_HALF_M, half_height_m]
    along_y = [_BIN_WALL_HALF_M, inner_m, half_height_m]
    walls = (
        ([0.0, offset_m, 0.0], along_x),
        ([0.0, -offset_m, 0.0], along_x),
        ([offset_m, 0.0, 0.0], along_y),
        ([-offset_m, 0.0, 0.0], along_y),
    )
    for side, (pos, size) in enumerate(walls):
        body.add_geom(
            name=f"{name}/{side}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=pos,
            size=size,
            rgba=display_rgba((0.8, 0.6, 0.4, 1)),
            **_solid(),
        )
    body.add_geom(
        name=f"{name}/floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.0, 0.0, -half_height_m / 2],
        size=[inner_m, inner_m, half_height_m / 2],
        rgba=(0, 0, 0, 1),
        **_seen_only(),
    )


def add_ghost_cube(spec: mujoco.MjSpec, name: str, half_m: float) -> None:
    """Adds a cube that is moved by script and only seen: the arm passes through it. Its origin is its centre."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[half_m] * 3, **_seen_only())


def _solid() -> dict[str, Any]:
    return {
        "contype": WORLD_BIT,
        "conaffinity": WORLD_BIT | ROBOT_BIT,
        "group": _VISIBLE,
        "solref": STIFF_SOLREF,
        "solimp": STIFF_SOLIMP,
    }


def _seen_only() -> dict[str, Any]:
    return {"contype": 0, "conaffinity": 0, "group": _VISIBLE}
