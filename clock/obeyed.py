"""The robot's own side of its commands: which of them it carries out, and what it does while none comes.

The clock service applies the same limits. Whoever holds the robot applies them once more, because what lies between,
a process of another version, a second sender, a lost message, is nobody's promise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from clock.dimensions import coasting
from clock.limits import why_not_obey
from protocol.messages import Action, Floats, Level, Robot

MAX_SKIPPED_S = 10
"""Seconds of ticks that the clock service may have skipped between two commands."""
_PLAYS = (Level.PLAY, Level.STALE)


@dataclass(slots=True)
class Obeyed:
    """The commands that one robot carried out in an episode.

    Attributes:
        command: (action_dim,), the newest.
        tick: the next one to be commanded.
    """

    robot: Robot
    control_hz: int
    command: Floats = field(init=False)
    tick: int = 0
    _played: Floats = field(init=False)
    _idle_ticks: int = 0  # of the newest command, since the newest row

    def __post_init__(self) -> None:
        self.command = self._played = self.robot.initial_command

    def why_not(self, action: Action, state: Floats | None) -> str:
        """Why ``action`` is not carried out; "" if it is. ``state``: (num_proprio,), the newest; None: not known."""
        num_ticks = action.tick - self.tick + 1
        if num_ticks > MAX_SKIPPED_S * self.control_hz:
            return f"expected tick {self.tick} or a few later, came {action.tick}"
        why_not = why_not_obey(action.values, self.command, self.robot, state, max(1, num_ticks))
        if why_not and num_ticks > 1:  # a clock that skipped ticks has let velocities end as this side did
            why_not = why_not_obey(action.values, self.idle(num_ticks - 1), self.robot, state, num_ticks)
        return why_not

    def obey(self, action: Action) -> None:
        """Notes that ``action`` is carried out."""
        is_row = action.level in _PLAYS
        self._idle_ticks = 0 if is_row else self._idle_ticks + max(1, action.tick - self.tick + 1)
        self._played = action.values if is_row else self._played
        self.command, self.tick = action.values, action.tick + 1

    def idle(self, num_ticks: int) -> Floats:
        """The command ``num_ticks`` after the newest one, if none has come: held, and velocities go on to zero."""
        return coasting(self.command, self._played, self.robot, self._idle_ticks + num_ticks)
