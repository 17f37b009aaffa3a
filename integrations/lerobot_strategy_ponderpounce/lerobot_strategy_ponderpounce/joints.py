"""Which number of LeRobot's is which of the gateway's robot file, and which drivers are refused before they move."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from lerobot.motors.motors_bus import MotorNormMode
from lerobot.robots import Robot

_FACTORS = {("rad", "deg"): 180 / math.pi, ("deg", "deg"): 1.0, ("%", "%"): 1.0, ("1", "%"): 100.0}
"""By the robot file's unit and the driver's."""


@dataclass(frozen=True)
class Joint:
    """``key``: LeRobot's. ``place``: in the state. ``factor``: LeRobot's number for one of the robot file's."""

    key: str
    place: int
    factor: float


def parts_of(robot: Robot) -> list[Robot]:
    """The robot, and the arms that it is made of."""
    return [robot, *(each for each in vars(robot).values() if isinstance(each, Robot))]


def check_driver(robot: Robot, holds_position: bool) -> None:
    """Raises ValueError for a driver that cannot be left alone, or whose own limit would not hold.

    ``holds_position``: a person says so of a driver that says nothing itself, as those of LeRobot 0.6.
    """
    says = getattr(robot, "supports_position_hold", None)
    if says is not True and not (says is None and holds_position):
        raise ValueError(
            f"{robot.name}: expected a driver with supports_position_hold, came {says}. If its servos hold the last"
            " target when commands stay away, say so: --holds-position"
        )
    for part in parts_of(robot):
        limit = getattr(getattr(part, "config", None), "max_relative_target", None)
        for value in limit.values() if isinstance(limit, dict) else [] if limit is None else [limit]:
            # In LeRobot an int raises at the first command, NaN is no limit, and a negative one turns it around.
            if type(value) is not float or not 0 < value < math.inf:
                raise ValueError(f"{part.name}: max_relative_target: expected floats above 0, came {value!r}")


def joints_of(robot: Robot, told: dict[str, Any]) -> list[Joint]:
    """The joints in the order of the commands.

    Args:
        told: the robot of the gateway's welcome.

    Raises:
        ValueError: names, kinds or units do not fit.
    """
    if odd := [key for key in robot.action_features if not key.endswith(".pos")]:
        raise ValueError(f"{robot.name}: expected actions that are positions (.pos), came {', '.join(odd)}")
    dimensions = told["dimensions"]
    wanted = {f"{each['name']}.pos" for each in dimensions}
    for features in (robot.action_features, robot.observation_features):
        given = {key for key in features if key.endswith(".pos")}
        if given != wanted:
            raise ValueError(f"{robot.name}: expected {_list(wanted)} by the gateway's robot file, came {_list(given)}")
    places = [each["state"] for each in dimensions]
    if sorted(place for place in places if place is not None) != list(range(told["num_proprio"])) or None in places:
        raise ValueError(f"the gateway's robot file: expected the state of every dimension and no other, came {places}")
    if odd := [each["name"] for each in dimensions if each["kind"] == "velocity"]:
        raise ValueError(f"{robot.name}: expected positions, came velocities: {', '.join(odd)}")
    return [Joint(f"{each['name']}.pos", each["state"], _factor(robot, each)) for each in dimensions]


def _factor(robot: Robot, dimension: dict[str, Any]) -> float:
    """By the motor's normalization; a driver that does not tell it has LeRobot's habit, degrees or percent."""
    motor = getattr(getattr(robot, "bus", None), "motors", {}).get(dimension["name"])
    name, unit = dimension["name"], dimension["unit"]
    is_deg = motor.norm_mode is MotorNormMode.DEGREES if motor is not None else unit in ("rad", "deg")
    theirs = "deg" if is_deg else "%"
    if (unit, theirs) not in _FACTORS:
        fit = " or ".join(repr(ours) for ours, other in _FACTORS if other == theirs)
        raise ValueError(f"{name}: {robot.name} has {theirs}; expected unit {fit} in the robot's file, came {unit!r}")
    return _FACTORS[unit, theirs]


def _list(keys: set[str]) -> str:
    return ", ".join(sorted(keys)) or "nothing"
