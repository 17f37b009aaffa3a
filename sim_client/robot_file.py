"""A robot's file: what its commands are, how far and how fast they go, and what each does at a stop (docs/robots.md).

Files from before dimensions were described have the fields of ``protocol.messages.Robot`` and are read as ever.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clock.schedules import CONTROL_HZ
from clock.timebase import NS_PER_MS
from protocol import checks, files
from protocol.messages import AtExit, AtStop, Dimension, DimensionKind, Floats, Robot
from protocol.robot_checks import AT_STOP

KIND = "robot for --robot-file"
MAX_PICTURE_AGE_MS = 500

_LISTS = ("command_low", "command_high", "max_step", "max_lead")
_STATE = ("state_low", "state_high")
_COMMON = {"name", "cameras", "num_proprio", "is_simulated", *_STATE}
_TIMES = ("max_picture_age_ms", "max_picture_skew_ms", "max_picture_still_ms")
_MAY = {"control_hz", "stop_ticks", "at_exit", *_TIMES}
_OF_DIMENSION = {"name", "kind", "low", "high", "step"}
_MAY_OF_DIMENSION = {"unit", "state", "lead", "at_stop", "initial", "home"}


@dataclass(frozen=True, slots=True)
class RobotFile:
    """A robot as its file describes it; ``robot`` is complete but for where it stands and its pictures' size."""

    robot: Robot
    initial: tuple[float | None, ...]
    """First command of each dimension; None: the measured value."""

    def describe(self, state: Floats, image_px: tuple[int, int]) -> Robot:
        """The robot as an episode begins, from its state, (num_proprio,), and its pictures' (height, width)."""
        robot = self.robot
        indices = [each.state_index for each in robot.dimensions] or list(range(robot.action_dim))
        known = [
            given if given is not None else state[at] if at is not None and at < len(state) else 0.0
            for given, at in zip(self.initial, indices, strict=True)
        ]
        is_rate = [each.kind == DimensionKind.VELOCITY for each in robot.dimensions] or [False] * robot.action_dim
        initial = np.where(is_rate, 0, np.asarray(known, np.float32))
        return replace(
            robot,
            initial_command=np.clip(initial, robot.command_low, robot.command_high).astype(np.float32),
            image_height=image_px[0],
            image_width=image_px[1],
        )


def read_robot(path: Path) -> RobotFile:
    """Reads a robot's file.

    Raises:
        OSError, FileError: the file cannot be read, or does not describe a robot that can be stopped.
    """
    text = files.read_text(path, KIND)
    with files.reading(path, KIND):
        return _robot_file(tomllib.loads(text))


def _robot_file(given: Mapping[str, Any]) -> RobotFile:
    has_dimensions = "dimension" in given
    must = _COMMON | ({"control_hz", "dimension"} if has_dimensions else set(_LISTS))
    may = _MAY if has_dimensions else {"control_hz", "initial_command"}
    _keys("", given, must, may)
    num_proprio = int(given["num_proprio"])
    if not 0 < num_proprio <= checks.MAX_DIM:
        raise ValueError(f"num_proprio {num_proprio}: expected 1 to {checks.MAX_DIM}")
    found = _described(given) if has_dimensions else _undescribed(given)
    checks.check_robot(found.describe(np.zeros(num_proprio, np.float32), (1, 1)))
    return found


def _undescribed(given: Mapping[str, Any]) -> RobotFile:
    lists = {name: np.asarray(given[name], np.float32) for name in _LISTS}
    robot = _robot(given, **lists, control_hz=int(given.get("control_hz", CONTROL_HZ)))
    initial = given.get("initial_command")
    return RobotFile(robot, (None,) * robot.action_dim if initial is None else tuple(map(float, initial)))


def _described(given: Mapping[str, Any]) -> RobotFile:
    tables = given["dimension"]
    for index, table in enumerate(tables):
        _keys(f"dimension {index}: ", table, _OF_DIMENSION, _MAY_OF_DIMENSION)
    homes = [float(table["home"]) for table in tables if "home" in table]
    if homes and len(homes) < len(tables):
        raise ValueError(f"home: expected one for each of the {len(tables)} dimensions or none, came {len(homes)}")
    age_ns, skew_ns, still_ns = (
        round(float(given.get(name, default)) * NS_PER_MS)
        for name, default in zip(_TIMES, (MAX_PICTURE_AGE_MS, 0, 0), strict=True)
    )
    robot = _robot(
        given,
        command_low=np.array([table["low"] for table in tables], np.float32),
        command_high=np.array([table["high"] for table in tables], np.float32),
        max_step=np.array([table["step"] for table in tables], np.float32),
        max_lead=np.array([table.get("lead", 0.0) for table in tables], np.float32),
        dimensions=tuple(map(_dimension, tables)),
        control_hz=int(given["control_hz"]),
        stop_ticks=int(given.get("stop_ticks", 0)),
        max_picture_age_ns=age_ns,
        max_picture_skew_ns=skew_ns,
        max_picture_still_ns=still_ns,
        at_exit=_chosen(AtExit, "at_exit", given.get("at_exit", "hold")),
        home=np.array(homes, np.float32),
    )
    return RobotFile(robot, tuple(_maybe(float, table.get("initial")) for table in tables))


def _robot(given: Mapping[str, Any], **fields: Any) -> Robot:
    low, high = (np.asarray(given[name], np.float32) for name in _STATE)
    return Robot(
        name=str(given["name"]),
        initial_command=fields["command_low"],
        cameras=tuple(given["cameras"]),
        image_height=1,
        image_width=1,
        num_proprio=int(given["num_proprio"]),
        is_simulated=bool(given["is_simulated"]),
        state_low=low,
        state_high=high,
        **fields,
    )


def _dimension(table: Mapping[str, Any]) -> Dimension:
    kind = _chosen(DimensionKind, "kind", table["kind"])
    choices = AT_STOP[kind]
    if "at_stop" not in table and len(choices) > 1:
        raise ValueError(f"{table['name']}: at_stop: expected {_named(choices)} for a {table['kind']}, came nothing")
    return Dimension(
        name=str(table["name"]),
        kind=kind,
        unit=str(table.get("unit", "")),
        state_index=_maybe(int, table.get("state")),
        at_stop=_chosen(AtStop, "at_stop", table["at_stop"]) if "at_stop" in table else choices[0],
    )


def _chosen(cls: Any, key: str, word: object) -> Any:
    names = {each.name.lower(): each for each in cls if each}
    if word not in names:
        raise ValueError(f"{key}: expected {_named(names.values())}, came {word!r}")
    return names[word]


def _named(choices: Any) -> str:
    return " or ".join(each.name.lower() for each in choices)


def _maybe(cls: Callable[[Any], Any], value: object) -> Any:
    return None if value is None else cls(value)


def _keys(at: str, given: Mapping[str, Any], must: set[str], may: set[str]) -> None:
    if missing := sorted(must - given.keys()):
        raise ValueError(f"{at}expected {', '.join(sorted(must))}; {', '.join(missing)} is missing")
    if odd := sorted(given.keys() - must - may):
        raise ValueError(f"{at}expected {', '.join(sorted(must | may))}; came {', '.join(odd)}")
