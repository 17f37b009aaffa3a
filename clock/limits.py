"""The last check before the robot: its limits, whatever the command's source and whatever was measured."""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag

import numpy as np

from clock.dimensions import dimensions_of
from protocol.messages import Floats, Robot

_ROUNDING = np.float32(1e-5)


class Hit(IntFlag):
    """Why a row was changed or not played (Tick.limits_hit)."""

    NONE = 0
    JOINT = 1
    STEP = 2
    NON_FINITE = 4
    LEAD = 8
    STATE = 16
    PICTURE_OLD = 32
    PICTURES_APART = 64
    PICTURE_STILL = 128
    SIGHT = PICTURE_OLD | PICTURES_APART | PICTURE_STILL


def within_limits(row: Floats, last_command: Floats, robot: Robot, state: Floats | None) -> tuple[Floats | None, Hit]:
    """Returns the row clipped to the limits, (action_dim,), or None if it must not be commanded, and the limits hit.

    The result is within the absolute limits and one step of ``last_command``; as far as these allow, it is also within
    the robot's lead over ``state``, (num_proprio,), the newest measured values (None: not known). The step is
    relative to the last command, not to the measured joints: a position-controlled arm lags its target by design, and
    limiting against the lag would slow it down twice. The lead is what keeps a blocked arm from winding up.
    """
    if not np.isfinite(row).all():
        return None, Hit.NON_FINITE
    hit = Hit.NONE
    inside = np.clip(row, robot.command_low, robot.command_high).astype(np.float32)
    if (inside != row).any():
        hit |= Hit.JOINT
    max_step = _unlimited(robot.max_step)
    low = np.maximum(robot.command_low, last_command - max_step)
    high = np.minimum(robot.command_high, last_command + max_step)
    stepped = np.clip(inside, low, high).astype(np.float32)
    if (stepped != inside).any():
        hit |= Hit.STEP
    if state is None:
        return stepped, hit
    near = _near(stepped, robot, state, _unlimited(robot.max_lead))
    if (near != stepped).any():
        hit |= Hit.LEAD
    return np.clip(near, low, high).astype(np.float32), hit


def following(last_command: Floats, robot: Robot, state: Floats) -> Floats:
    """The command of a stopped robot: it stays, unless somebody moves the arm away from it by more than a step.

    Then it goes along, at most a step per tick, so that the arm does not snap back when motion is allowed again.
    A robot without ``max_lead`` is not followed.
    """
    if not len(robot.max_lead):
        return last_command
    is_led = np.zeros(robot.action_dim, np.bool_)
    joints = dimensions_of(robot).targets  # a hand may have moved these; grippers and rates are not asked
    is_led[joints] = robot.max_lead[joints] > 0
    wanted = _near(last_command, robot, state, np.where(is_led, _unlimited(robot.max_step), np.inf))
    followed, _ = within_limits(wanted, last_command, robot, None)
    return last_command if followed is None else followed


def in_place(last_command: Floats, robot: Robot, state: Floats) -> Floats:
    """The command that leaves the arm where it was measured, within the absolute limits.

    Grippers, velocities and what is not measured stay as they were commanded.
    """
    dims, measured = dimensions_of(robot), last_command.copy()
    measured[dims.targets] = state[dims.state_of_targets]
    return np.clip(measured, robot.command_low, robot.command_high).astype(np.float32)


def stop_target(last_command: Floats, robot: Robot, state: Floats) -> Floats:
    """Where a deceleration ends: as ``in_place``, for those dims that a stop leads to their measured value."""
    return np.where(dimensions_of(robot).ends_measured_A, in_place(last_command, robot, state), last_command)


def why_not_obey(values: Floats, last_command: Floats, robot: Robot, state: Floats | None, num_ticks: int) -> str:
    """Why a command, (action_dim,), must not be carried out; "" if it may be: the robot's own side asks.

    It must be within the absolute limits, and within a step for each of the ``num_ticks`` since ``last_command``,
    counted from there or, because a stopped arm may have been moved by hand, from ``state``, (num_proprio,), as it was
    last measured (None: not known).
    """
    if values.shape != robot.command_low.shape:
        return f"expected {robot.action_dim} values, came {len(values)}"
    if not ((robot.command_low <= values) & (values <= robot.command_high)).all():
        return f"expected values within the joint limits, came {values.tolist()}"
    reach = _unlimited(robot.max_step) * np.float32(num_ticks) + _ROUNDING * np.maximum(1, np.abs(values))
    distance = np.abs(values - last_command)
    if state is not None:
        dims = dimensions_of(robot)
        from_measured = np.abs(values[dims.targets] - state[dims.state_of_targets])
        distance[dims.targets] = np.minimum(distance[dims.targets], from_measured)
    if (distance <= reach).all():
        return ""
    dim = int(np.argmax(distance - reach))
    return (
        f"expected at most {reach[dim]:.4g} from the last command in {num_ticks} tick(s), came {distance[dim]:.4g} in "
        f"dimension {dim}"
    )


def slowed(robot: Robot, speed: float) -> Robot:
    """The robot at a share of its speed: shorter steps, and lower velocities, which it then leaves in the same time."""
    share = np.float32(speed)
    rates = dimensions_of(robot).velocities
    low, high = robot.command_low.copy(), robot.command_high.copy()
    low[rates], high[rates] = low[rates] * share, high[rates] * share
    return replace(robot, command_low=low, command_high=high, max_step=(robot.max_step * share).astype(np.float32))


def without_lead(robot: Robot) -> Robot:
    """The robot whose commands may be as far from what was measured as they come."""
    return replace(robot, max_lead=np.zeros(robot.action_dim, np.float32))


def is_in_range(state: Floats, robot: Robot) -> bool:
    """Whether every measured value is one that this robot can have."""
    if not len(robot.state_low):
        return True
    return bool(((robot.state_low <= state) & (state <= robot.state_high)).all())


def out_of_range(state: Floats, robot: Robot) -> str:
    """A sentence about the first measured value that this robot cannot have; "" if there is none."""
    if is_in_range(state, robot):
        return ""
    dim = int(np.argmax(~((robot.state_low <= state) & (state <= robot.state_high))))
    low, high = robot.state_low[dim], robot.state_high[dim]
    return (
        f"state {dim} is {state[dim]:.4g}, which {robot.name} cannot measure: expected {low:.4g} to {high:.4g}. "
        "Are these its joints, in its units and order?"
    )


def _near(row: Floats, robot: Robot, state: Floats, distance: Floats) -> Floats:
    """``row``, at most ``distance`` (() is any) from the values measured for the same dims; other dims as they are."""
    near = row.copy()
    if len(distance):
        dims = dimensions_of(robot)
        at, center = dims.measured, state[dims.state_index]
        near[at] = np.clip(row[at], center - distance[at], center + distance[at])
    return near


def _unlimited(limits: Floats) -> Floats:
    """Limits with infinity for 0."""
    return np.where(limits > 0, limits, np.float32(np.inf)).astype(np.float32)
