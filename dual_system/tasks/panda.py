"""The arm in numbers: robosuite's Panda with RoboMME's gains, home pose and tool points; with a gripper or a stick.

Nothing here needs MuJoCo, so that a gateway on a robot's computer knows the arm without a simulator (`panda_model`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("finger_joint1", "finger_joint2")  # the second one opens towards negative values
FINGER_BODIES = ("leftfinger", "rightfinger")
TCP_SITE = "tcp"
HOME_QPOS = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4])  # rad
HOME_OPENING_M = 0.04
OPEN, CLOSED = 1.0, -1.0  # gripper commands
BASE_POSITION_M = (-0.615, 0.0, 0.0)
IMAGE_PX = 256  # of its two cameras, upstream's; grounded texts count in these pixels

# Franka's, as in robosuite's robot.xml.
JOINT_LOW_RAD = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
JOINT_HIGH_RAD = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])

ROBOT_BIT, WORLD_BIT = 2, 1  # contact bits: the robot touches the world, not itself
# As stiff as the physics step allows. With MuJoCo's defaults the fingers sink millimetres into the light cube they
# squeeze.
STIFF_SOLREF, STIFF_SOLIMP = (0.01, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)

_FINGER_TARGET_M = (-0.01, 0.04)  # where commands -1 and +1 drive one finger; below 0 means squeezing
STATE_SLACK = np.array([0.1] * 7 + [0.02])
"""How far beyond its limits a state (8,) can be measured [rad, m]: limits are soft, and an arm that comes down on a
thing presses its fingers apart with 100 N and more."""
STICK_FROM_HAND_M = (0.05, 0.15)  # where it begins, inside the hand, and where its tip is


@dataclass(frozen=True, slots=True, kw_only=True)
class Robot:
    """The arm's tool, and the layout of states (8,) and actions (8,) that follows from it.

    Both begin with the seven joints [rad]. With a gripper, the state ends with one finger's opening [m] and the action
    with a command in [-1, 1], -1 closed. Without one, the state ends with 0 and the action with -1, which moves
    nothing.
    """

    name: str  # upstream's
    has_gripper: bool
    tcp_from_hand_m: float
    oracle_speed_rad_s: float  # how fast a joint turns in the scripted motions

    @property
    def state_low(self) -> Array:
        """The least a state (8,) can be."""
        return np.append(JOINT_LOW_RAD, 0.0)

    @property
    def state_high(self) -> Array:
        """The most a state (8,) can be."""
        return np.append(JOINT_HIGH_RAD, HOME_OPENING_M if self.has_gripper else 0.0)

    @property
    def action_low(self) -> Array:
        """The least an action (8,) can ask for."""
        return np.append(JOINT_LOW_RAD, CLOSED)

    @property
    def action_high(self) -> Array:
        """The most an action (8,) can ask for."""
        return np.append(JOINT_HIGH_RAD, self.rest_command)

    @property
    def rest_command(self) -> float:
        """An action's last entry while nothing is done: the gripper is open, if there is one."""
        return OPEN if self.has_gripper else CLOSED

    @property
    def finger_joints(self) -> tuple[str, ...]:
        """The names of the fingers' joints; none without a gripper."""
        return FINGER_JOINTS if self.has_gripper else ()

    @property
    def finger_bodies(self) -> tuple[str, ...]:
        """The names of the fingers; none without a gripper."""
        return FINGER_BODIES if self.has_gripper else ()

    @property
    def open_fingers_m(self) -> Array:
        """Joint positions of the open fingers (2,), or (0,) without a gripper."""
        return HOME_OPENING_M * np.array([1.0, -1.0] if self.has_gripper else [])

    def control_of(self, action: Array) -> Array:
        """Returns actuator set points for an action (8,): seven joints [rad], then the fingers if there are any [m]."""
        if not self.has_gripper:
            return action[:7]
        opening_m = np.interp(action[7], (CLOSED, OPEN), _FINGER_TARGET_M)  # clips
        return np.concatenate([action[:7], [opening_m, -opening_m]])

    def gripper_command_of(self, control: Array) -> float:
        """Returns the action's last entry behind set points (9,); always -1 without a gripper."""
        if not self.has_gripper:
            return CLOSED
        return float(np.interp(control[7], _FINGER_TARGET_M, (CLOSED, OPEN)))


PANDA_WRISTCAM = Robot(name="panda_wristcam", has_gripper=True, tcp_from_hand_m=0.1034, oracle_speed_rad_s=0.9)
PANDA_STICK = Robot(name="panda_stick", has_gripper=False, tcp_from_hand_m=STICK_FROM_HAND_M[1], oracle_speed_rad_s=0.3)
_ROBOTS = {robot.name: robot for robot in (PANDA_WRISTCAM, PANDA_STICK)}


def robot_in(model: Any) -> Robot:
    """Returns the robot that a compiled scene was built around: the scene carries its name."""
    return _ROBOTS[model.names.split(b"\0", 1)[0].decode()]
