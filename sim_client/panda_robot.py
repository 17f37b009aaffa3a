"""Our Panda as the protocol describes a robot: its limits and cameras. It needs no simulator."""

from __future__ import annotations

import numpy as np

from dual_system.tasks import panda
from protocol.messages import Robot

CAMERAS = ("front", "wrist")
CONTROL_HZ = 20

# Franka's datasheet: 2.175 rad/s (joints 1-4), 2.61 rad/s (5-7). RoboMME's own data reach 1.2 rad/s.
_MAX_JOINT_RAD_S = np.array([2.175] * 4 + [2.61] * 3)
# At full speed these servos lag by up to 0.26 rad (kd / kp = 0.1 s) and a step of 0.13; the oracles' reach 0.12.
_MAX_LEAD_RAD = 0.4
_GRIPPER_UNLIMITED = 0.0  # a switch: the hand itself limits how fast it closes; a stick has nothing to limit


def simulated_robot(robot: panda.Robot, initial_state: np.ndarray) -> Robot:
    """The robot at reset; its servos hold ``initial_state`` (8,), with the gripper open if there is one."""
    return Robot(
        name=robot.name,
        command_low=robot.action_low.astype(np.float32),
        command_high=robot.action_high.astype(np.float32),
        max_step=np.append(_MAX_JOINT_RAD_S / CONTROL_HZ, _GRIPPER_UNLIMITED).astype(np.float32),
        initial_command=np.clip(
            np.append(initial_state[:7], robot.rest_command), robot.action_low, robot.action_high
        ).astype(np.float32),
        cameras=CAMERAS,
        image_height=panda.IMAGE_PX,
        image_width=panda.IMAGE_PX,
        num_proprio=8,
        is_simulated=True,
        max_lead=np.array([_MAX_LEAD_RAD] * 7 + [_GRIPPER_UNLIMITED], np.float32),
        state_low=(robot.state_low - panda.STATE_SLACK).astype(np.float32),
        state_high=(robot.state_high + panda.STATE_SLACK).astype(np.float32),
        control_hz=CONTROL_HZ,
    )
