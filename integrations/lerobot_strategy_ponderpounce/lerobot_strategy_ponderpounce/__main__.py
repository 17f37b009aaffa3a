"""A LeRobot robot's own program: ``--robot.type`` and the like as LeRobot's commands have them, and
``--holds-position`` for a driver that does not say by itself that its servos hold the last target.

python -m lerobot_strategy_ponderpounce --robot.type=so101_follower --robot.port=/dev/ttyACM0 --instruction "..."
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import pkgutil
import sys
from dataclasses import dataclass
from typing import Any

import draccus
import lerobot.robots
from lerobot.configs import parser
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.import_utils import register_third_party_plugins
from ponderpounce_client import leave_holding, main

from lerobot_strategy_ponderpounce.arm import Arm


@dataclass
class Asked:
    """What LeRobot's parser reads."""

    robot: RobotConfig


def robot_of(arguments: list[str]) -> Robot:
    """The robot of ``--robot.*``. Raises SystemExit as LeRobot's commands do."""
    for each in pkgutil.iter_modules(lerobot.robots.__path__, "lerobot.robots."):
        with contextlib.suppress(ImportError):  # a driver whose extra is not installed
            importlib.import_module(each.name)
    register_third_party_plugins()
    for path in parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, arguments).values():
        parser.load_plugin(path)
    known = [each for each in arguments if f".{parser.PLUGIN_DISCOVERY_SUFFIX}" not in each]
    return make_robot_from_config(draccus.parse(Asked, args=known).robot)


def run() -> int:
    ours = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    ours.add_argument("--holds-position", action="store_true")
    said, rest = ours.parse_known_args()
    theirs = [each for each in rest if each.startswith("--robot.")]
    if odd := [each for each in theirs if "=" not in each]:
        ours.error(f"{odd[0]}: expected --robot.NAME=VALUE")
    arms: list[Arm] = []

    def new_robot(cameras: dict[str, Any], welcome: dict[str, Any]) -> Arm:
        arms.append(Arm(robot_of(theirs), welcome, cameras, holds_position=said.holds_position, say=print))
        return arms[0]

    code = main(new_robot, leave_holding, argv=[each for each in rest if each not in theirs], description=__doc__)
    for arm in arms:
        arm.close()
    return code


if __name__ == "__main__":
    sys.exit(run())
