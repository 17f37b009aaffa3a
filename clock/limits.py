"""The last gate before the robot: joint limits, the step limit, and no NaN, whoever asked for it."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from protocol.messages import Floats, Robot


class Hit(IntFlag):
    """What a row ran into (Tick.limits_hit)."""

    NONE = 0
    JOINT = 1
    STEP = 2
    NON_FINITE = 4


def within_limits(row: Floats, last_command: Floats, robot: Robot) -> tuple[Floats | None, Hit]:
    """The row as it may be commanded, (action_dim,), or None if it may not be commanded at all.

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
