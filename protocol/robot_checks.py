"""What a robot's description must say: of its commands as a whole, and of each dimension, so that it can be stopped.

Every rule of a dimension is one that the ladder relies on: a velocity that cannot reach zero in time, or a line to a
value that is not measured, is refused before anything moves.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from protocol.messages import AtExit, AtStop, Dimension, DimensionKind, Robot

MIN_CONTROL_HZ, MAX_CONTROL_HZ = 5, 100
MAX_CAMERAS, MAX_NAME = 8, 128
_MAX_PICTURE_NS = 10**18  # as instants

AT_STOP = {
    DimensionKind.POSITION: (AtStop.HOLD, AtStop.MEASURED),
    DimensionKind.DELTA: (AtStop.HOLD, AtStop.MEASURED),
    DimensionKind.VELOCITY: (AtStop.ZERO,),
    DimensionKind.GRIPPER: (AtStop.KEEP,),
}
"""What a dimension of each kind may do at a stop."""


def faults(robot: Robot) -> Iterator[tuple[str, str, object]]:
    """Yields (field, expected, came) of all that is wrong with a robot whose vectors have the right sizes."""
    yield from _ranges(robot)
    yield from _names(robot)
    if robot.control_hz and not MIN_CONTROL_HZ <= robot.control_hz <= MAX_CONTROL_HZ:
        yield "control_hz", f"{MIN_CONTROL_HZ} to {MAX_CONTROL_HZ}", robot.control_hz
    for name in ("max_picture_age_ns", "max_picture_skew_ns", "max_picture_still_ns"):
        if not 0 <= getattr(robot, name) <= _MAX_PICTURE_NS:
            yield name, "0 to 31 years", getattr(robot, name)
    yield from _home(robot)
    if not robot.dimensions:
        return
    if len(robot.dimensions) != robot.action_dim:
        yield "dimensions", f"{robot.action_dim}, one for each number of a command", len(robot.dimensions)
        return
    names = [each.name for each in robot.dimensions]
    if len(set(names)) < len(names) or not all(names):
        yield "dimensions", "names, each once", ", ".join(map(repr, names))
    for index, each in enumerate(robot.dimensions):
        yield from _dimension(robot, index, each)


def _ranges(robot: Robot) -> Iterator[tuple[str, str, object]]:
    low, high, first = robot.command_low, robot.command_high, robot.initial_command
    if not (low <= high).all():
        yield "command_low", "<= command_high", "the opposite"
    if not (robot.max_step >= 0).all():
        yield "max_step", ">= 0", "a negative step"
    if not ((low <= first) & (first <= high)).all():
        yield "initial_command", "within command_low and command_high", first
    if len(robot.max_lead) not in (0, robot.action_dim) or not (robot.max_lead >= 0).all():
        yield "max_lead", f"{robot.action_dim} >= 0", robot.max_lead
    if len(robot.state_low) != len(robot.state_high) or not (robot.state_low <= robot.state_high).all():
        yield "state_low", "<= state_high", "the opposite"


def _names(robot: Robot) -> Iterator[tuple[str, str, object]]:
    if len(robot.name) > MAX_NAME:
        yield "name", f"at most {MAX_NAME} characters", len(robot.name)
    if len(robot.cameras) > MAX_CAMERAS:
        yield "cameras", f"at most {MAX_CAMERAS}", len(robot.cameras)
    if (longest := max(map(len, robot.cameras), default=0)) > MAX_NAME:
        yield "cameras", f"names of at most {MAX_NAME} characters", longest


def _dimension(robot: Robot, index: int, each: Dimension) -> Iterator[tuple[str, str, object]]:
    at = f"dimensions[{index}]"
    if max(len(each.name), len(each.unit)) > MAX_NAME:
        yield at, f"a name and a unit of at most {MAX_NAME} characters", len(each.name) + len(each.unit)
    if each.kind not in AT_STOP:
        yield f"{at}.kind", "position, velocity, delta or gripper", each.kind.name.lower()
        return
    at = f"dimensions[{index}] ({each.name})"
    if each.at_stop not in AT_STOP[each.kind]:
        allowed = " or ".join(stop.name.lower() for stop in AT_STOP[each.kind])
        yield f"{at}.at_stop", f"{allowed} for a {each.kind.name.lower()}", each.at_stop.name.lower()
    is_measured = each.state_index is not None
    if each.state_index is not None and not 0 <= each.state_index < robot.num_proprio:
        yield f"{at}.state", f"0 to {robot.num_proprio - 1}, an index of the state", each.state_index
    if not is_measured and each.at_stop == AtStop.MEASURED:
        yield f"{at}.state", "the index of its measured value, where a stop ends", "none"
    if not is_measured and each.kind == DimensionKind.DELTA:
        yield f"{at}.state", "the index of its measured value, to which increments are added", "none"
    if not is_measured and len(robot.max_lead) and robot.max_lead[index] > 0:
        yield f"{at}.state", "the index of its measured value, over which it has a lead", "none"
    if each.kind == DimensionKind.VELOCITY:
        yield from _velocity(robot, index, at)


def _velocity(robot: Robot, index: int, at: str) -> Iterator[tuple[str, str, object]]:
    low, high = float(robot.command_low[index]), float(robot.command_high[index])
    if not low <= 0 <= high:
        yield f"{at}.low", "limits with zero between them: a velocity must be able to end", f"{low:g} to {high:g}"
    if robot.initial_command[index] != 0:
        yield f"{at}.initial", "0 for a velocity", float(robot.initial_command[index])
    if robot.stop_ticks < 1:
        yield "stop_ticks", "1 or more, within which velocities are zero", robot.stop_ticks
        return
    fastest, step = np.float32(max(-low, high)), robot.max_step[index]
    if 0 < step < fastest / robot.stop_ticks:
        yield (
            f"{at}.step",
            f"at least {fastest / robot.stop_ticks:g}, to be zero in {robot.stop_ticks} ticks",
            float(step),
        )


def _home(robot: Robot) -> Iterator[tuple[str, str, object]]:
    if not len(robot.home):
        if robot.at_exit == AtExit.PARK:
            yield "home", "where to park, because at_exit is park", "nothing"
        return
    inside = len(robot.home) == robot.action_dim and np.isfinite(robot.home).all()
    if not inside or ((robot.home < robot.command_low) | (robot.command_high < robot.home)).any():
        yield "home", f"{robot.action_dim} numbers within the limits", robot.home.tolist()
