"""The robot that a client drives, as the protocol describes it: ours, or one described by a TOML file."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dual_system.tasks.panda import PANDA_WRISTCAM
from protocol import checks, files
from protocol.messages import Floats, Robot
from sim_client.robot import simulated_robot

_OPTIONAL = {"initial_command"}
_LIMITS = ("command_low", "command_high", "max_step", "max_lead", "state_low", "state_high")
_MEASURED = {"image_height", "image_width"}
_KIND = "robot for --robot-file"


@dataclass(frozen=True, slots=True)
class Body:
    """How many numbers a state has; and from the joints at the beginning of an episode and the pictures' (height,
    width) to the robot's description."""

    num_proprio: int
    describe: Callable[[Floats, tuple[int, int]], Robot]

    def example(self) -> Robot:
        """The description for a state of zeros and pictures of one pixel."""
        return self.describe(np.zeros(self.num_proprio, np.float32), (1, 1))


def _panda(state: Floats, image_px: tuple[int, int]) -> Robot:
    return replace(simulated_robot(PANDA_WRISTCAM, state), image_height=image_px[0], image_width=image_px[1])


PANDA = Body(8, _panda)
"""The Panda of our tasks and of RoboMME: absolute joint targets and a gripper; with a stick, the last is ignored."""


def read_body(path: Path) -> Body:
    """A body from a file with the fields of ``protocol.messages.Robot``, but the pictures' size, which is measured.

    Without ``initial_command`` the robot holds, until its first command, the first numbers of its state.

    Raises:
        OSError, FileError: the file cannot be read, or does not describe a robot.
    """
    text = files.read_text(path, _KIND)
    with files.reading(path, _KIND):
        return _body(tomllib.loads(text))


def _body(given: dict[str, Any]) -> Body:
    expected = {each.name for each in fields(Robot)} - _MEASURED
    if given.keys() - expected or expected - _OPTIONAL - given.keys():
        raise ValueError(f"expected {', '.join(sorted(expected))}; came {', '.join(sorted(given))}")
    num_proprio = int(given["num_proprio"])
    if not 0 < num_proprio <= checks.MAX_DIM:
        raise ValueError(f"num_proprio {num_proprio}: expected 1 to {checks.MAX_DIM}")
    checks.check_robot(_robot(given, np.zeros(num_proprio, np.float32), (1, 1)))
    return Body(num_proprio, lambda state, image_px: _robot(given, state, image_px))


def _robot(given: dict[str, Any], state: Floats, image_px: tuple[int, int]) -> Robot:
    limits = {name: np.asarray(given[name], np.float32) for name in _LIMITS}
    initial = given.get("initial_command")
    if initial is None:
        initial = np.clip(state[: len(limits["command_low"])], limits["command_low"], limits["command_high"])
    return Robot(
        name=str(given["name"]),
        **limits,
        initial_command=np.asarray(initial, np.float32),
        cameras=tuple(given["cameras"]),
        image_height=image_px[0],
        image_width=image_px[1],
        num_proprio=int(given["num_proprio"]),
        is_simulated=bool(given["is_simulated"]),
    )
