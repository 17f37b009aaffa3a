"""PandaOmron: robosuite's Panda with its gripper on an Omron base that drives and lifts, with RoboCasa's cameras.

Names are those of robosuite's files without its prefixes. Only the files are used, see `panda_model`.
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from dual_system.tasks.kitchen.skins import SEEN_GROUP, Skin, dress, skins
from dual_system.tasks.panda import ROBOT_BIT, STIFF_SOLIMP, STIFF_SOLREF, WORLD_BIT
from dual_system.tasks.panda_model import robosuite_assets

NAME = "PandaOmron"
ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("finger_joint1", "finger_joint2")  # the second one opens towards negative values
BASE_JOINTS = ("joint_mobile_forward", "joint_mobile_side", "joint_mobile_yaw")
TORSO_JOINT = "joint_torso_height"
ARM_MOTORS = tuple(f"torq_j{i}" for i in range(1, 8))
FINGER_MOTORS = tuple(f"gripper_{joint}" for joint in FINGER_JOINTS)
BASE_MOTORS = tuple(joint.replace("joint", "actuator", 1) for joint in BASE_JOINTS)
TORSO_MOTOR = "actuator_torso_height"
GRIP_SITE = "grip_site"  # between the finger pads
HAND_BODY = "right_hand"
FINGER_BODIES = ("leftfinger", "rightfinger")
ROOT_BODY = "mobile_base"
BASE_SITE = "center"  # where the arm stands on the base; the base's pose in the state
ARM_SITE = "right_center"  # the same point; the frame of the arm's commands

START_QPOS = np.array([-0.0161, -1.0345, -0.0240, -2.2755, 0.0393, 1.5164, 0.6962])  # rad, RoboCasa's
START_FINGERS_M = np.array([0.020833, -0.020833])  # robosuite's
OPEN_M = 0.04
AIR = (1.2, 2e-5)
"""Density and viscosity of robosuite's air. Its hands are light with large inertias, so that air slows their turns."""

VIEWS = ("ego_view", "ego_view_right", "hand_view")
_CAMERAS = {  # name: body, position [m], quaternion wxyz, vertical field of view [degrees]
    "ego_view": ("support", (-0.5, 0.35, 1.05), (0.55624, 0.29935, -0.37679, -0.67751), 60.0),
    "ego_view_right": ("support", (-0.5, -0.35, 1.05), (0.67751, 0.37679, -0.29935, -0.55624), 60.0),
    "hand_view": (HAND_BODY, (0.05, 0.0, 0.0), (0.0, 0.70711, 0.70711, 0.0), 75.0),  # robosuite's own field of view
}
_FILES = {
    "base": "bases/omron_mobile_base.xml",
    "arm": "robots/panda/robot.xml",
    "gripper": "grippers/panda_gripper.xml",
}
_CELL_M = {"base": 0.07, "arm": 0.03, "gripper": 0.012}


def panda_omron_spec() -> mujoco.MjSpec:
    """Returns a fresh, uncompiled PandaOmron: attach it where it stands, its x axis forward, z = 0 the floor.

    Raises FileNotFoundError if robosuite's assets are not installed.
    """
    base, arm, gripper = (_light(part) for part in ("base", "arm", "gripper"))
    base.modelname = NAME
    base.body("base").name = ROOT_BODY
    arm.body("base").name = "arm_base"
    for joint, armature in zip(ARM_JOINTS, 5.0 / np.arange(1, 8), strict=True):
        arm.joint(joint).armature = armature  # robosuite sets these where it loads the file
        arm.joint(joint).frictionloss = 0.1
    for spec in (base, arm, gripper):
        for unused in [*spec.cameras, *spec.sensors]:
            spec.delete(unused)
    hand = arm.body(HAND_BODY)
    arm.attach(gripper, prefix="", frame=hand.add_frame())
    base.attach(arm, prefix="", frame=base.body("support").add_frame())
    for name, (body, position_m, quaternion, fovy) in _CAMERAS.items():
        base.body(body).add_camera(name=name, pos=position_m, quat=quaternion, fovy=fovy)
    for geom in base.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = ROBOT_BIT, WORLD_BIT
    for finger in (1, 2):
        pad = base.geom(f"finger{finger}_pad_collision")
        pad.friction, pad.condim = [2.0, 0.05, 0.0001], 4
        pad.solref, pad.solimp = STIFF_SOLREF, STIFF_SOLIMP
    return base


def start(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Puts the arm and the fingers to where RoboCasa's episodes start. Call mj_forward after it."""
    for joint, value in zip((*ARM_JOINTS, *FINGER_JOINTS), (*START_QPOS, *START_FINGERS_M), strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = value


def _light(part: str) -> mujoco.MjSpec:
    spec = _source(part)
    dress(spec, _skins(part))
    for geom in spec.geoms:
        if geom.group == SEEN_GROUP and not geom.meshname:  # the base's column, which the file draws over its own shape
            geom.contype, geom.conaffinity, geom.mass = 0, 0, 0.0
    return spec


@functools.cache
def _skins(part: str) -> tuple[Skin, ...]:
    """Takes a second, once."""
    return skins(_source(part), _CELL_M[part])


def _source(part: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(robosuite_assets() / _FILES[part]))
