"""The scene around the arm: table, lights, cameras, and the props that a task may put on the table.

A prop is added to the specification once, under a name, and placed anew for each episode by `Physics.place`. Cubes move
freely; buttons, discs and other scripted objects are mocap bodies, so that their poses are part of the physics state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.geometry import Footprint, is_clear
from dual_system.tasks.panda import (
    PANDA_WRISTCAM,
    ROBOT_BIT,
    STIFF_SOLIMP,
    STIFF_SOLREF,
    WORLD_BIT,
    Robot,
)
from dual_system.tasks.panda_model import panda_spec

FRONT, WRIST = "front", "wrist"
CAMERAS = (FRONT, WRIST)  # upstream calls them base_camera and hand_camera
PHYSICS_STEP_S = 0.005

CUBE_HALF_M = 0.02
BUTTON_HALF_M = (0.0375, 0.0375)
BUTTON_BASE_HEIGHT_M = 0.015
_CAP_TRAVEL_M = 0.015
DISC_RADIUS_M = 0.05

RGBA = tuple[float, float, float, float]
# Pure colours read the same in linear and in display space; anything else goes through `display_rgba`.
CUBE_COLORS: dict[str, RGBA] = {"red": (1, 0, 0, 1), "blue": (0, 0, 1, 1), "green": (0, 1, 0, 1)}
WHITE: RGBA = (1, 1, 1, 1)

_EYE_M, _AIM_M = (0.3, 0.0, 0.4), (0.0, 0.0, -0.2)  # the front camera's
_RIGHT = (0.0, 1.0, 0.0)  # it faces the robot: image right is the robot's left
_FOV_DEG = 90.0  # from top to bottom, and as wide

_VISIBLE = 1  # geom group that the cameras see; group 0 holds the arm's collision shapes
_GROUND_Z_M = -0.92
_TABLE_X_M, _TABLE_Y_M = (-0.74, 0.47), (-1.21, 1.20)
_TABLE_FRICTION = [0.3, 0.005, 0.0001]
_GRAIN_PX = 512


class SceneFullError(RuntimeError):
    """No free place was found for an object."""


def display_rgba(linear: RGBA) -> RGBA:
    """Returns the display (sRGB) colour of a linear one.

    Upstream states base colours as linear light and its renderer encodes them; MuJoCo's draws numbers as they are.
    """
    *rgb, alpha = linear
    r, g, b = (12.92 * c if c <= 0.0031308 else 1.055 * c ** (1 / 2.4) - 0.055 for c in rgb)
    return r, g, b, alpha


def table_scene(robot: Robot = PANDA_WRISTCAM) -> mujoco.MjSpec:
    """Returns a robot at its table with lights and the two cameras; tasks add their props before it is compiled."""
    spec = panda_spec(robot)
    spec.option.timestep = PHYSICS_STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones and a stiff friction ratio: with MuJoCo's defaults a held cube creeps out of the fingers.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.visual.quality.offsamples = 0  # antialiasing alone would double the cost of a software-rendered frame
    spec.visual.quality.shadowsize = 0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
    spec.stat.extent = 1.0  # znear and zfar are fractions of it; upstream's are metres
    _add_room(spec)
    _add_lights(spec)
    _add_cameras(spec)
    return spec


def add_cube(spec: mujoco.MjSpec, name: str, half_m: float = CUBE_HALF_M) -> None:
    """Adds a free cube; its origin is its centre. Density 1000 kg/m3: 64 g at the usual size."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half_m] * 3,
        density=1000.0,
        friction=_TABLE_FRICTION,
        condim=4,
        **_solid(),
    )


def add_button(spec: mujoco.MjSpec, name: str) -> None:
    """Adds a button, origin on the table: a white base and ``name/cap``, a grey cap on a vertical spring.

    The cap can go down 15 mm. Upstream it is stopped there by the table.
    """
    base = spec.worldbody.add_body(name=name, mocap=True)
    half_height_m = BUTTON_BASE_HEIGHT_M / 2
    base.add_geom(
        name=f"{name}/base",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[*BUTTON_HALF_M, half_height_m],
        pos=[0.0, 0.0, half_height_m],
        rgba=WHITE,
        **_solid(),
    )
    cap = base.add_body(name=f"{name}/cap", pos=[0.0, 0.0, BUTTON_BASE_HEIGHT_M])
    cap.add_joint(
        name=f"{name}/cap",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0.0, 0.0, 1.0],
        limited=True,
        range=[-_CAP_TRAVEL_M, 0.0],
        stiffness=[800.0, 0.0, 0.0],
        damping=[40.0, 0.0, 0.0],
        # MuJoCo's stops are soft in proportion to the mass they stop, and the cap weighs 43 g. This inertia lets
        # the stop hold a pressing arm; the cap still follows its spring and damper, whose time constant is far
        # longer.
        armature=0.3,
        solref_limit=STIFF_SOLREF,
        solimp_limit=STIFF_SOLIMP,
    )
    cap.add_geom(
        name=f"{name}/cap",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.0225, 0.009, 0.0],
        pos=[0.0, 0.0, 0.009],
        mass=0.04267,
        rgba=display_rgba((0.5, 0.5, 0.5, 1)),
        **_solid(),
    )
    for below in (name, "world"):
        spec.add_exclude(bodyname1=below, bodyname2=f"{name}/cap")


def add_disc(spec: mujoco.MjSpec, name: str, radius_m: float = DISC_RADIUS_M, rgba: RGBA = WHITE) -> None:
    """Adds a flat disc that is only seen, never touched; its origin is its centre."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius_m, 0.001, 0.0],
        rgba=rgba,
        contype=0,
        conaffinity=0,
        group=_VISIBLE,
    )


def sample_footprint(
    rng: np.random.Generator,
    *,
    center_m: tuple[float, float],
    reach_m: tuple[float, float],
    half_m: tuple[float, float],
    yaw_range_rad: tuple[float, float],
    obstacles: Sequence[Footprint],
    gap_m: float,
    max_tries: int = 256,
) -> Footprint:
    """Draws a footprint with its centre uniform in ``center_m`` +- ``reach_m``, ``gap_m`` from all obstacles.

    Raises SceneFullError after ``max_tries`` draws that all met an obstacle.
    """
    for _ in range(max_tries):
        x_m, y_m = (float(rng.uniform(c - r, c + r)) for c, r in zip(center_m, reach_m, strict=True))
        drawn = Footprint(center_m=(x_m, y_m), half_m=half_m, yaw_rad=float(rng.uniform(*yaw_range_rad)))
        if all(is_clear(drawn, obstacle, gap_m) for obstacle in obstacles):
            return drawn
    raise SceneFullError(
        f"no free place for a {2 * half_m[0]:.3f} x {2 * half_m[1]:.3f} m footprint after {max_tries} tries: "
        f"{len(obstacles)} obstacles within {reach_m} m of {center_m}, gap {gap_m} m. Draw the scene again."
    )


def _solid() -> dict[str, Any]:
    return {
        "contype": WORLD_BIT,
        "conaffinity": WORLD_BIT | ROBOT_BIT,
        "group": _VISIBLE,
        "solref": STIFF_SOLREF,
        "solimp": STIFF_SOLIMP,
    }


def _add_room(spec: mujoco.MjSpec) -> None:
    table_half = [(_TABLE_X_M[1] - _TABLE_X_M[0]) / 2, (_TABLE_Y_M[1] - _TABLE_Y_M[0]) / 2, -_GROUND_Z_M / 2]
    table_center = [sum(_TABLE_X_M) / 2, sum(_TABLE_Y_M) / 2, _GROUND_Z_M / 2]
    texture = spec.add_texture(
        name="wood", type=mujoco.mjtTexture.mjTEXTURE_2D, width=_GRAIN_PX, height=_GRAIN_PX, nchannel=3
    )
    texture.data = wood_grain().tobytes()
    wood = spec.add_material(name="wood", specular=0.0, texrepeat=[1.0, 1.0])
    wood.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "wood"
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=table_half,
        pos=table_center,
        material="wood",
        friction=_TABLE_FRICTION,
        condim=4,
        **_solid(),
    )
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[20.0, 20.0, 1.0],
        pos=[0.0, 0.0, _GROUND_Z_M],
        rgba=(0.45, 0.48, 0.51, 1),
        **_solid(),
    )


def _add_lights(spec: mujoco.MjSpec) -> None:
    """Ambient and two directional lights as upstream, with strengths matched by eye to its display values."""
    spec.visual.headlight.ambient = [0.55] * 3
    spec.visual.headlight.diffuse = [0.0] * 3
    spec.visual.headlight.specular = [0.0] * 3
    for direction, strength in (((1.0, 1.0, -1.0), 0.2), ((0.0, 0.0, -1.0), 0.25)):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0.0, 0.0, 3.0],
            dir=direction,
            castshadow=False,
            ambient=[0.0] * 3,
            diffuse=[strength] * 3,
            specular=[0.1] * 3,
        )


def _add_cameras(spec: mujoco.MjSpec) -> None:
    eye = np.array(_EYE_M)
    back = (eye - np.array(_AIM_M)) / np.linalg.norm(eye - np.array(_AIM_M))
    spec.worldbody.add_camera(name=FRONT, pos=eye, xyaxes=[*_RIGHT, *np.cross(back, _RIGHT)], fovy=_FOV_DEG)
    # In the hand's frame +z leaves the palm and the fingers open along y. Image right is +y, image up is +x.
    spec.body("right_hand").add_camera(
        name=WRIST, pos=[0.0465, -0.02, 0.036], xyaxes=[0.0, 1.0, 0.0, 1.0, 0.0, 0.0], fovy=90.0
    )


def wood_grain() -> NDArray[np.uint8]:
    """Returns a wood-like texture (512, 512, 3): streaks along y that repeat without a seam, always the same."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((_GRAIN_PX, _GRAIN_PX))
    cycles = np.fft.fftfreq(_GRAIN_PX, 1 / _GRAIN_PX)
    along, across = np.meshgrid(cycles, cycles, indexing="ij")
    smooth = np.exp(-((along / 6) ** 2) - (across / 90) ** 2)
    streaks = np.fft.ifft2(np.fft.fft2(noise) * smooth).real
    streaks = np.clip(streaks / streaks.std(), -2.5, 2.5)
    brown = np.array([206.0, 124.0, 77.0])
    return np.clip(brown + streaks[..., None] * np.array([15.0, 13.0, 11.0]), 0, 255).astype(np.uint8)
