"""The last check before the robot: its limits, whatever the command's source and whatever was measured."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from protocol.messages import Floats, Robot


class Hit(IntFlag):
    """Why a row was changed or not played (Tick.limits_hit)."""

    NONE = 0
    JOINT = 1
    STEP = 2
    NON_FINITE = 4
    LEAD = 8
    STATE = 16


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
    near = _near(stepped, state, _unlimited(robot.max_lead))
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
    wanted = _near(last_command, state, np.where(robot.max_lead > 0, _unlimited(robot.max_step), np.inf))
    followed, _ = within_limits(wanted, last_command, robot, None)
    return last_command if followed is None else followed


def in_place(last_command: Floats, robot: Robot, state: Floats) -> Floats:
    """The command that leaves the arm where it was measured, within the absolute limits; the gripper, last, stays."""
    arm = state[: len(last_command) - 1]
    measured = np.concatenate([arm, last_command[len(arm) :]])
    return np.clip(measured, robot.command_low, robot.command_high).astype(np.float32)


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


def _near(row: Floats, state: Floats, distance: Floats) -> Floats:
    """``row``, at most ``distance`` from the values measured for the same dims; other dims as they are."""
    num = min(len(row), len(state), len(distance))
    near = row.copy()
    near[:num] = np.clip(row[:num], state[:num] - distance[:num], state[:num] + distance[:num])
    return near


def _unlimited(limits: Floats) -> Floats:
    """Limits with infinity for 0."""
    return np.where(limits > 0, limits, np.float32(np.inf)).astype(np.float32)
