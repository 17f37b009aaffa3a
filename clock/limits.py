"""The last check before the robot: joint limits, step limit, and no NaN, whatever the command's source."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from protocol.messages import Floats, Robot


class Hit(IntFlag):
    """The limits that a row hit (Tick.limits_hit)."""

    NONE = 0
    JOINT = 1
    STEP = 2
    NON_FINITE = 4


def within_limits(row: Floats, last_command: Floats, robot: Robot) -> tuple[Floats | None, Hit]:
    """Returns the row clipped to the limits, (action_dim,), or None if it must not be commanded, and the limits hit.

    The step limit is relative to the last command, not to the measured joints: a position-controlled arm lags its
    target by design, and limiting against the lag would slow it down twice.
    """
    if not np.isfinite(row).all():
        return None, Hit.NON_FINITE
    hit = Hit.NONE
    clipped = np.clip(row, robot.command_low, robot.command_high).astype(np.float32)
    if (clipped != row).any():
        hit |= Hit.JOINT
    max_step = np.where(robot.max_step > 0, robot.max_step, np.float32(np.inf)).astype(np.float32)
    stepped = np.clip(clipped, last_command - max_step, last_command + max_step).astype(np.float32)
    if (stepped != clipped).any():
        hit |= Hit.STEP
    return stepped, hit
