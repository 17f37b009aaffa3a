"""The degradation ladder, which selects each tick's command: play, stale, hold, decelerate, stop.

A command is a chunk's row, the last command, or an interpolation from it to the measured joints; never zeros, never an
extrapolation. Once decelerating, only ``engage`` starts motion again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.messages import Floats, Level, Schedule


@dataclass(slots=True)
class Ladder:
    """The robot's current rung. Call ``step`` once per tick, in tick order."""

    schedule: Schedule
    level: Level = Level.HOLD
    held_ticks: int = 0
    slowing_ticks: int = 0
    has_played: bool = False
    _from: Floats | None = None
    _to: Floats | None = None

    @property
    def is_latched(self) -> bool:
        return self.level in (Level.DECELERATE, Level.STOPPED)

    def engage(self) -> None:
        """Allows motion again: back to HOLD, then playing as soon as there is a row."""
        self.level, self.held_ticks, self.slowing_ticks = Level.HOLD, 0, 0

    def stop(self) -> None:
        """Stops at once, until somebody engages."""
        self.level = Level.STOPPED

    def step(self, row: Floats | None, is_stale: bool, last_command: Floats, in_place: Floats) -> Floats:
        """Returns the command of this tick and sets ``level`` to its rung.

        Args:
            row: (action_dim,) within limits, from a chunk; None if no chunk has one.
            is_stale: the cognition behind ``row`` is older than ``max_age_ns``.
            last_command: (action_dim,).
            in_place: (action_dim,), where a deceleration ends: the measured joints, and the gripper as it is.
        """
        if not self.is_latched:
            if row is not None:
                self.level, self.held_ticks, self.has_played = (
                    Level.STALE if is_stale else Level.PLAY,
                    0,
                    True,
                )
                return row
            # Before the first row no row was lost: the servos hold their reset position.
            self.held_ticks += self.has_played
            if self.held_ticks <= self.schedule.hold_limit_ticks:
                self.level = Level.HOLD
                return last_command
            self.level, self.slowing_ticks = Level.DECELERATE, 0
            self._from, self._to = last_command, in_place
        if self.level == Level.STOPPED or self._from is None or self._to is None:
            return last_command
        self.slowing_ticks += 1
        share = np.float32(min(1.0, self.slowing_ticks / max(1, self.schedule.decelerate_ticks)))
        if share >= 1:
            self.level = Level.STOPPED
        return (self._from + share * (self._to - self._from)).astype(np.float32)
