"""One episode between a client that asks and a clock that commands. Pure: requests, commands and instants in, messages
out.

An answer of several rows is a command and a forecast. The command is the clock's, for the request's tick; the forecast
is the same chunk's rows for the following ticks, within the robot's limits. In lockstep the client plays all rows and
then sends its next request: only then are the ticks in between commanded, each with its own observation, and the
commands equal the forecast, because no chunk is generated in between. In live mode the clock does not wait for the
client, and commands may differ from the forecast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from clock.dimensions import dimensions_of
from clock.obeyed import Obeyed
from clock.playback import deadline_ns
from clock.timebase import NS_PER_S
from protocol import messages as m
from sim_client.gateway.exchange import Answer, Behind
from sim_client.gateway.rule import ahead
from sim_client.robot_end import STOPPED_S

_KEEP_CHUNKS = 8
_LATE_TICKS = 2  # a command may be on its way for one


class Measurement(NamedTuple):
    """A client's observation at one tick, in the form to publish."""

    pictures: tuple[m.Image, ...]
    state: m.Floats
    robot_state: m.RobotState = m.RobotState.UNSPECIFIED
    robot_text: str = ""


@dataclass(slots=True)
class Commands:
    """The newest command, the clock's account of it, and the chunks that it may have come from."""

    robot: m.Robot
    control_hz: int
    obeyed: Obeyed = field(init=False)
    newest: m.Action | None = None
    _account: m.Tick | None = None
    _chunks: dict[int, m.ActionChunk] = field(default_factory=dict)
    _ponder_ns: int = 0
    _gate_scores: dict[int, float | None] = field(default_factory=dict)  # by query, from the one in use on
    _subgoal: m.Subgoal | None = None

    def __post_init__(self) -> None:
        self.obeyed = Obeyed(self.robot, self.control_hz)

    def on_action(self, action: m.Action) -> None:
        self.newest = action
        self.obeyed.obey(action)

    def on_account(self, account: m.Tick) -> None:
        self._account = account
        if account.ref_query is not None:
            while self._gate_scores and (oldest := min(self._gate_scores)) < account.ref_query:
                del self._gate_scores[oldest]

    def on_chunk(self, chunk: m.ActionChunk) -> None:
        self._chunks[chunk.invocation] = chunk
        while len(self._chunks) > _KEEP_CHUNKS:
            del self._chunks[min(self._chunks)]

    def on_cognition(self, cognition: m.Cognition) -> None:
        self._ponder_ns = cognition.infer_ns
        self._gate_scores[cognition.query] = cognition.gate_score

    def on_subgoal(self, subgoal: m.Subgoal) -> None:
        """Keeps the newest one that PONDER has told; a blank one says that none is in force."""
        if subgoal.kind == m.SubgoalKind.SUBGOAL:
            self._subgoal = subgoal

    def answer(self, num_rows: int) -> Answer | None:
        """The newest command and its forecast; None while the forecast is unknown."""
        newest, account = self.newest, self._account
        if newest is None:
            return None
        chunk: m.ActionChunk | None = None
        if num_rows > 1:
            if account is None or account.tick != newest.tick:
                return None
            if account.invocation is not None and (chunk := self._chunks.get(account.invocation)) is None:
                return None
        rows, levels = ahead(newest, chunk, self.robot, num_rows)
        return Answer(rows_NA=rows, tick=newest.tick, levels=levels, behind=self._behind(newest))

    def _behind(self, newest: m.Action) -> Behind:
        account, subgoal = self._account, self._subgoal
        chunk = self._chunks.get(account.invocation) if account and account.invocation is not None else None
        return Behind(
            subgoal=subgoal.text.strip() if subgoal is not None else "",
            subgoal_age_ns=max(0, newest.tick - subgoal.tick) * NS_PER_S // self.control_hz if subgoal else 0,
            cognition_age_ns=account.age_ns if account is not None else 0,
            gate_score=self._gate_scores.get(account.ref_query) if account and account.ref_query is not None else None,
            ponder_ns=self._ponder_ns,
            pounce_ns=chunk.infer_ns if chunk is not None else 0,
        )


@dataclass(slots=True)
class LockstepNode:
    """Counts ticks. Call ``show`` with observations, pass in each command, and take ``answer`` when it is complete."""

    info: m.EpisodeInfo
    num_rows: int
    tick: int = 0
    """The next one to be commanded."""
    commands: Commands = field(init=False)
    _start_ns: int = 0
    _coming: list[Measurement] = field(default_factory=list)
    _last: Measurement | None = None
    _asked_tick: int = 0  # of the request under way

    def __post_init__(self) -> None:
        self.commands = Commands(self.info.robot, self.info.schedule.control_hz)

    def show(self, since: Sequence[Measurement], now: Measurement) -> m.Observation:
        """Takes a request's observations since the last request and now; returns the observation to publish.

        If the client does not send the observations in between, the last one is repeated.
        """
        if self._last is None:
            self._coming = [now]
        else:
            repeated = [self._last] * (self.num_rows - 1 - len(since))
            self._coming = [*since, *repeated, now]
        self._last = now
        self._asked_tick = self.tick + len(self._coming) - 1
        return self._next()

    def on_action(self, action: m.Action) -> m.Observation | None:
        """Takes the command of the current tick; returns what is published for the next one, while there is more."""
        if action.tick != self.tick or self._last is None:
            return None
        if self.tick == 0:
            self._start_ns = action.deadline_ns
        self.commands.on_action(action)
        self.tick += 1
        return self._next() if self._coming else None

    def answer(self) -> Answer | None:
        """The rows of the request, once its own tick has been commanded."""
        return self.commands.answer(self.num_rows) if self.tick > self._asked_tick else None

    def _next(self) -> m.Observation:
        shown = self._coming.pop(0)
        source_ns = deadline_ns(self._start_ns, self.tick, self.info.schedule.control_hz)
        return m.Observation(tick=self.tick, source_ns=source_ns, proprio=shown.state, images=shown.pictures)


@dataclass(slots=True)
class LiveNode:
    """Follows the clock's commands; ``answer`` is what holds at this moment.

    ``waits_for_person``: an episode that the ladder stopped goes on until somebody engages it again.
    """

    info: m.EpisodeInfo
    num_rows: int
    waits_for_person: bool = False
    tick: int = 0
    """The next one to be commanded."""
    zero_ns: int | None = None
    """Episode time 0 on this host's monotonic clock, as far as the commands tell: the first one may come late."""
    commands: Commands = field(init=False)
    _stopped_ticks: int = 0

    def __post_init__(self) -> None:
        self.commands = Commands(self.info.robot, self.info.schedule.control_hz)

    def show(self, now: Measurement, now_ns: int) -> m.Observation:
        """The observation to publish for a request at ``now_ns``, episode time, at the first tick that it can serve."""
        return m.Observation(
            tick=self.tick, source_ns=now_ns, proprio=now.state, images=now.pictures,
            robot_state=now.robot_state, robot_text=now.robot_text,
        )  # fmt: skip

    def on_action(self, action: m.Action, host_ns: int) -> None:
        """Takes a command that came at ``host_ns``, this host's monotonic clock."""
        if action.tick < self.tick:
            return
        zero_ns = host_ns - action.header.at_ns
        self.zero_ns = zero_ns if self.zero_ns is None else min(zero_ns, self.zero_ns)
        self.commands.on_action(action)
        self.tick = action.tick + 1
        self._stopped_ticks = self._stopped_ticks + 1 if action.level == m.Level.STOPPED else 0

    def answer(self, host_ns: int, after_tick: int = -1) -> Answer | None:
        """The current command and its forecast; None before the first command after ``after_tick``.

        If no command has come for some ticks at ``host_ns``, this host's monotonic clock, velocities go on to zero.
        """
        newest = self.commands.newest
        if newest is None or newest.tick <= after_tick or (answer := self.commands.answer(self.num_rows)) is None:
            return None
        due_ns, robot = newest.deadline_ns + (self.zero_ns or 0), self.info.robot
        late_ticks = (host_ns - due_ns) * self.info.schedule.control_hz // NS_PER_S
        if late_ticks >= min(_LATE_TICKS, max(1, robot.stop_ticks)) and len(dimensions_of(robot).velocities):
            rows = [self.commands.obeyed.idle(late_ticks + ahead) for ahead in range(self.num_rows)]
            answer = replace(answer, rows_NA=np.stack(rows), levels=(m.Level.HOLD,) * self.num_rows)
        return replace(answer, deadline_ns=due_ns)

    @property
    def is_over(self) -> bool:
        """Whether the ladder has stopped the robot for so long that the episode ends."""
        return self._stopped_ticks > STOPPED_S * self.info.schedule.control_hz and not self.waits_for_person


Node = LockstepNode | LiveNode
