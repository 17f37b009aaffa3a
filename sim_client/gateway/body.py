"""The robot that a client drives, as the protocol describes it: ours, or one described by its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clock.schedules import CONTROL_HZ
from dual_system.tasks import panda
from protocol.messages import Floats, Robot
from sim_client.panda_robot import simulated_robot
from sim_client.robot_file import read_robot


@dataclass(frozen=True, slots=True)
class Body:
    """How many numbers a state has; from the joints at the beginning of an episode and the pictures' (height, width)
    to the robot's description; and how many commands it takes a second."""

    num_proprio: int
    describe: Callable[[Floats, tuple[int, int]], Robot]
    control_hz: int = CONTROL_HZ

    def example(self) -> Robot:
        """The description for a state of ones and pictures of one pixel."""
        return self.describe(np.ones(self.num_proprio, np.float32), (1, 1))


def _panda(state: Floats, image_px: tuple[int, int]) -> Robot:
    return _at(panda.PANDA_WRISTCAM, state, image_px)


def _robomme(state: Floats, image_px: tuple[int, int]) -> Robot:
    """RoboMME's episodes begin with an open gripper, or with a stick, whose finger it reports as exactly 0."""
    return _at(panda.PANDA_WRISTCAM if state[7] else panda.PANDA_STICK, state, image_px)


def _at(robot: panda.Robot, state: Floats, image_px: tuple[int, int]) -> Robot:
    return replace(simulated_robot(robot, state), image_height=image_px[0], image_width=image_px[1])


PANDA = Body(8, _panda)
"""The Panda of our tasks: absolute joint targets and a gripper's."""
ROBOMME = Body(8, _robomme)
"""The Panda of RoboMME's clients, in some tasks with a stick, which ignores the gripper's target."""


def read_body(path: Path) -> Body:
    """A body from a robot's file. Raises OSError, FileError as ``read_robot``."""
    found = read_robot(path)
    return Body(found.robot.num_proprio, found.describe, found.robot.control_hz)
