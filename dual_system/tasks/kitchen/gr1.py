"""Fourier's GR-1 with its hands, from robosuite's files: a puppet that is put into poses and touches nothing."""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from dual_system.tasks.kitchen.skins import Skin, dress, skins
from dual_system.tasks.panda_model import robosuite_assets

NAME = "GR1"
BASE_HEIGHT_M = 0.97
WAIST_JOINTS = ("torso_waist_yaw", "torso_waist_pitch", "torso_waist_roll")
ARM_JOINTS = tuple(
    f"r_{joint}"
    for joint in (
        "shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow_pitch", "wrist_yaw", "wrist_roll", "wrist_pitch",
    )
)  # fmt: skip
ROOT_BODY = "gr1"
TOOL_SITE = "tool"
"""Between thumb and fingers of the right hand, with the axes of a script's tool: z ahead, y where they close."""

_TOOL_M, _TOOL_QUAT = (-0.06, 0.015, -0.12), (0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0)  # in the wrist's frame
_HALF_EXTENDED = {"r_shoulder_roll": -0.1, "l_shoulder_roll": 0.1, "r_elbow_pitch": -1.57, "l_elbow_pitch": -1.57}
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_CURL_RAD = {"proximal": 0.75, "intermediate": 0.9, "distal": 0.5, "proximal_pitch": 0.45, "proximal_yaw": 1.2}
_OPEN_SHARE = 0.15  # of the curl
_FILES = {
    "body": "robots/gr1/robot.xml",
    "left": "grippers/fourier_left_hand.xml",
    "right": "grippers/fourier_right_hand.xml",
}
_CELL_M = {"body": 0.015, "left": 0.008, "right": 0.008}


def gr1_spec() -> mujoco.MjSpec:
    """Returns a fresh, uncompiled GR-1: attach it where it stands, its x axis forward, z = 0 the floor.

    Raises FileNotFoundError if robosuite's assets are not installed.
    """
    spec, left, right = (_light(part) for part in ("body", "left", "right"))
    spec.modelname = NAME
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    base = spec.body("base")
    base.name, base.pos = ROOT_BODY, [0.0, 0.0, BASE_HEIGHT_M]
    spec.body("right_eef").add_site(name=TOOL_SITE, pos=_TOOL_M, quat=_TOOL_QUAT, group=4)
    for side, hand in (("left", left), ("right", right)):
        spec.attach(hand, prefix=f"{side}_fourier_", frame=spec.body(f"{side}_eef").add_frame())
    for body in spec.bodies[1:]:
        body.explicitinertial, body.mass, body.inertia = True, 0.1, [1e-3] * 3  # nothing is simulated
    return spec


def start(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Puts the arms half extended in front of the body, as robosuite's GR-1 starts, the fingers open."""
    for joint, value in _HALF_EXTENDED.items():
        data.qpos[model.joint(joint).qposadr[0]] = value
    for side in ("left", "right"):
        curl(model, data, side, 0.0)


def curl(model: mujoco.MjModel, data: mujoco.MjData, side: str, share: float) -> None:
    """Closes the fingers of one hand: 0 open, 1 round a small thing."""
    letter = side[0].upper()
    for finger in _FINGERS:
        for part, closed_rad in _CURL_RAD.items():
            name = f"{side}_fourier_{letter}_{finger}_{part}_joint"
            if (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)) >= 0:
                bent = closed_rad if part == "proximal_yaw" else closed_rad * max(share, _OPEN_SHARE)
                data.qpos[model.joint(name).qposadr[0]] = bent


def _light(part: str) -> mujoco.MjSpec:
    spec = _source(part)
    dress(spec, _skins(part))
    for unused in [*spec.cameras, *spec.sensors, *spec.actuators, *spec.sites, *spec.excludes]:
        spec.delete(unused)
    for geom in list(spec.geoms):
        if not geom.meshname or geom.contype:
            spec.delete(geom)
    return spec


@functools.cache
def _skins(part: str) -> tuple[Skin, ...]:
    """Takes two seconds, once."""
    return tuple(skin for skin in skins(_source(part), _CELL_M[part]) if not skin.collides)


def _source(part: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(robosuite_assets() / _FILES[part]))
