"""The command of each tick: a chunk's row within the robot's limits, or what the ladder makes of having none.

The rule carries a few values from tick to tick and reads no clock; the conductor and ``pp-check`` apply the same one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from clock.dimensions import coasting, dimensions_of
from clock.ladder import Ladder
from clock.limits import Hit, following, in_place, is_in_range, stop_target, within_limits
from clock.playback import Chunk
from protocol.messages import EpisodeInfo, Floats, Level, RobotState

NO_ROW: Floats = np.zeros(0, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What is commanded at a tick, and why."""

    command: Floats
    level: Level
    hit: Hit
    chunk: Chunk | None
    """The chunk whose row is played, if one is."""
    seam_jump: float
    """Largest difference, grippers aside, from the last command to a new chunk's first row; 0 between switches."""


@dataclass(slots=True)
class Commander:
    """One episode's commands. Call ``step`` once per commanded tick, in order."""

    info: EpisodeInfo
    ladder: Ladder = field(init=False)
    last_command: Floats = field(init=False)
    blocked_ticks: int = 0
    _last_played: Floats = field(init=False)
    _idle_ticks: int = 0  # since a row was played
    _is_engaging: bool = False
    _played_invocation: int | None = None

    def __post_init__(self) -> None:
        self.ladder = Ladder(self.info.schedule)
        self.last_command = self._last_played = self.info.robot.initial_command

    @property
    def is_blocked(self) -> bool:
        return self.blocked_ticks > blocked_ticks(self.info.schedule.control_hz)

    def engage(self) -> None:
        """Allows motion again, from where the arm is at the next tick: somebody may have moved it."""
        self.ladder.engage()
        self._is_engaging, self.blocked_ticks = True, 0

    def step(
        self,
        raw: Floats,
        chunk: Chunk | None,
        state: Floats | None,
        robot_state: RobotState,
        *,
        state_ticks: int = 0,
        sight: Hit = Hit.NONE,
    ) -> Decision:
        """Decides one tick.

        Args:
            raw: (action_dim,), the row of ``chunk`` for this tick before the limits; (0,) if there is none.
            chunk: the newest usable chunk.
            state: (num_proprio,), the newest measured values; None before the first observation.
            robot_state: what the robot says of itself.
            state_ticks: age of ``state`` in ticks. An old one says nothing of an arm's lead: it has moved since.
            sight: why the pictures are no ground to move on.
        """
        robot = self.info.robot
        measured = state if state is not None and is_in_range(state, robot) else None
        if self._is_engaging and measured is not None:
            self.last_command, self._is_engaging = in_place(self.last_command, robot, measured), False
        if not robot_state.obeys:
            self.ladder.stop()
        row, hit = None, Hit.NONE
        if chunk is not None:
            is_fresh = state_ticks <= max_state_ticks(self.info.schedule.control_hz)
            row, hit = within_limits(raw, self.last_command, robot, measured if is_fresh else None)
        self.blocked_ticks = self.blocked_ticks + 1 if Hit.LEAD in hit else 0
        if state is not None and measured is None:
            hit |= Hit.STATE
        hit |= sight
        if hit & (Hit.STATE | Hit.SIGHT) or self.is_blocked:
            row = None
        command = self._on_ladder(row, chunk, measured)
        level = self.ladder.level
        played = chunk if level in (Level.PLAY, Level.STALE) else None
        jump = self._jump(played, raw)
        if played is None:
            self._idle_ticks += 1
            command = coasting(command, self._last_played, robot, self._idle_ticks)
        else:
            self._last_played, self._idle_ticks = command, 0
        self.last_command = command
        return Decision(command=command, level=level, hit=hit, chunk=played, seam_jump=jump)

    def skip(self, num_ticks: int) -> None:
        """Ticks that passed without a command: the robot's side held, and its velocities went on to zero."""
        self._idle_ticks += num_ticks
        self.last_command = coasting(self.last_command, self._last_played, self.info.robot, self._idle_ticks)

    def _on_ladder(self, row: Floats | None, chunk: Chunk | None, measured: Floats | None) -> Floats:
        robot, last = self.info.robot, self.last_command
        is_stale = chunk is not None and chunk.age_ns > self.info.schedule.max_age_ns
        target = last if measured is None else stop_target(last, robot, measured)
        command = self.ladder.step(row, is_stale, last, target)
        if not self.ladder.is_latched:
            return command
        if self.ladder.level == Level.STOPPED and measured is not None:
            command = following(command, robot, measured)
        limited, _ = within_limits(command, last, robot, None)
        return last if limited is None else limited

    def _jump(self, chunk: Chunk | None, raw: Floats) -> float:
        if chunk is None or chunk.invocation == self._played_invocation or not np.isfinite(raw).all():
            return 0.0
        self._played_invocation = chunk.invocation
        moves = ~dimensions_of(self.info.robot).is_gripper_A
        return float(np.abs(raw[moves] - self.last_command[moves]).max(initial=0.0))


def blocked_ticks(control_hz: int) -> int:
    """Half a second at the lead over the measured joints, after which a blocked arm is held."""
    return control_hz // 2


def max_state_ticks(control_hz: int) -> int:
    """Largest age of a measured state, 100 ms or two ticks, from which the lead is taken."""
    return max(2, control_hz // 10)
