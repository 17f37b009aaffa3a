"""The robot's side of one episode: publishes observations, executes commands, and is safe when the commands stop.

The simulated world moves only by commanded ticks. The observation of tick k+1 is published as soon as it is rendered,
with the instant it belongs to; the schedule uses it from that instant on, so transport and rendering lie between ticks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from clock.obeyed import Obeyed
from clock.playback import deadline_ns
from clock.report import CLOCK_LOST_EVENT
from clock.timebase import NS_PER_MS
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Snapshot
from protocol import images
from protocol import messages as m
from protocol.drops import DropReason
from protocol.link import Link, Stream
from protocol.topics import ACTION, EVENT, OBSERVATION, PHASE, SUBGOAL, TICK
from sim_client.recorder import Recorder
from sim_client.robot import observation, status_of
from sim_client.robot_end import STOPPED_S, is_sound, stopped_reason
from sim_client.silence import CLOCK_SILENCE_NS, STALL_NS, Silence
from sim_client.worlds import World

HOLD_S = 0.5
"""Time for which the robot then holds before it ends the episode."""

Others = Callable[[int], None]
"""Lets the other participants run: returns when a message may have come, or after the given nanoseconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How an episode ended for the robot."""

    status: m.TaskStatus
    reason: str
    num_ticks: int


def always(tick: int) -> bool:
    """Renders every tick."""
    return True


@dataclass(slots=True)
class RobotSide:
    """Runs one episode with the publisher of actions. A tick for which ``looks`` is False is not rendered."""

    link: Link
    actions: Stream[m.Action]
    """The link's subscription, one for all episodes: each is a thread of the bus."""
    environment: World
    recorder: Recorder
    let_others: Others
    patience_ns: int
    looks: Callable[[int], bool] = always
    first_done_tick: int | None = None
    """The first tick whose observation shows the first subtask done."""
    first_choice: bool | None = None
    """Whether the episode's first choice was right; None if it made none."""
    first_choice_tick: int | None = None
    _tick: int = 0
    _start_ns: int = 0
    _control_hz: int = 1
    _obeyed: Obeyed = field(init=False)
    _texts: tuple[str, str] = ("", "")
    _subgoal_index: int = -1
    _stopped_ticks: int = 0

    @property
    def num_ticks(self) -> int:
        """Number of ticks played so far."""
        return self._tick

    def run(self, info: m.EpisodeInfo, first: Snapshot, on_tick: Callable[[int], None]) -> Outcome:
        """Plays until the task ends, or the servers do."""
        self.actions.drain()  # of the last episode
        snapshot = first
        self._begin(info)
        self._show(snapshot, 0)
        self.link.publish(PHASE, m.Phase(state="running"), at_ns=0)
        is_lockstep = info.schedule.mode == m.Mode.LOCKSTEP  # there others may compute in this process, as they please
        silence = Silence(time.monotonic_ns(), self.patience_ns if is_lockstep else STALL_NS)
        while True:
            self.recorder.step()
            for action in self.actions.drain():
                if not self.link.is_from(action.header, "clock") or action.tick < self._tick:
                    continue
                if not is_sound(self.link, action, self._obeyed, snapshot.state):
                    continue
                snapshot = self._obey(info, action)
                self.recorder.step()  # each time: many commands may wait, and it keeps few observations
                on_tick(self._tick)
                silence.heard(time.monotonic_ns())
                if snapshot.status is not Status.ONGOING:
                    return Outcome(status=status_of(snapshot), reason=snapshot.reason, num_ticks=self._tick)
                if self._stopped_ticks > STOPPED_S * self._control_hz:
                    return self._abort(stopped_reason(self.recorder.last_error))
            if self.link.second_sender:  # nobody can say which of the two is meant
                self._tell(
                    m.Severity.ERROR, DropReason.SECOND_SENDER, f"holding the last command: {self.link.second_sender}"
                )
                self._hold()
                return self._abort(self.link.second_sender)
            if silence.total_ns > self._limit_ns(info):
                if self._tick == 0:
                    return self._abort(f"no command came within {silence.total_ns / 1e9:.0f} s")
                text = f"no command for {silence.total_ns / 1e6:.0f} ms: holding the last one"
                self._tell(m.Severity.ERROR, CLOCK_LOST_EVENT, text)
                self._hold()
                return self._abort("clock lost")
            self.let_others(20 * NS_PER_MS)
            if away_ns := silence.look(time.monotonic_ns()):
                text = f"the robot's own process stood still for {away_ns / NS_PER_MS:.0f} ms"
                self._tell(m.Severity.WARNING, "robot_stalled", text)

    def _begin(self, info: m.EpisodeInfo) -> None:
        self._control_hz = info.schedule.control_hz
        self._obeyed = Obeyed(info.robot, self._control_hz)

    def _limit_ns(self, info: m.EpisodeInfo) -> int:
        waits = info.schedule.mode == m.Mode.LOCKSTEP or self._tick == 0
        return self.patience_ns if waits else CLOCK_SILENCE_NS

    def _obey(self, info: m.EpisodeInfo, action: m.Action) -> Snapshot:
        """One commanded tick; before it, the ticks that the clock skipped, in which the servos held."""
        if self._tick == 0 and action.tick == 0:
            self._start_ns = action.deadline_ns
        for tick in range(self._tick, action.tick):
            snapshot = self.environment.step(self._obeyed.idle(tick - self._tick + 1))
            if snapshot.status is not Status.ONGOING:  # it ended before the tick that is commanded
                self._tick = tick + 1
                self._show(snapshot, deadline_ns(self._start_ns, self._tick, info.schedule.control_hz))
                return snapshot
        self._obeyed.obey(action)
        self._stopped_ticks = self._stopped_ticks + 1 if action.level == m.Level.STOPPED else 0
        self._tick = action.tick + 1
        snapshot = self.environment.step(action.values, look=self.looks(self._tick))
        self._show(snapshot, deadline_ns(self._start_ns, self._tick, info.schedule.control_hz))
        return snapshot

    def _show(self, snapshot: Snapshot, source_ns: int) -> None:
        codec = images.wire_codec(self.link.bus.is_local)
        self.link.publish(OBSERVATION, observation(snapshot, self._tick, source_ns, codec), at_ns=source_ns)
        texts = (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        kinds = (m.SubgoalKind.TASK_SIMPLE, m.SubgoalKind.TASK_GROUNDED)
        is_new = snapshot.subgoal_index != self._subgoal_index  # published again even if its text is the same
        for kind, text, before in zip(kinds, texts, self._texts, strict=True):
            if is_new or text != before:
                subgoal = m.Subgoal(kind=kind, text=text, tick=self._tick)
                self.link.publish(SUBGOAL, subgoal, at_ns=source_ns)
        self._texts, self._subgoal_index = texts, snapshot.subgoal_index
        if self.first_done_tick is None and snapshot.subtask_index > 0:
            self.first_done_tick = self._tick
        if self.first_choice is None and snapshot.first_choice is not None:
            self.first_choice, self.first_choice_tick = snapshot.first_choice, self._tick

    def _hold(self) -> None:
        for ticks in range(round(HOLD_S * self._control_hz)):
            if self.environment.step(self._obeyed.idle(ticks + 1)).status is not Status.ONGOING:
                return

    def _abort(self, reason: str) -> Outcome:
        return Outcome(status=m.TaskStatus.ABORTED, reason=reason, num_ticks=self._tick)

    def _tell(self, severity: m.Severity, name: str, text: str) -> None:
        event = m.Event(severity=severity, name=name, text=text, tick=self._tick)
        self.link.publish(EVENT, event, at_ns=deadline_ns(self._start_ns, self._tick, self._control_hz))


def play_oracle(
    info: m.EpisodeInfo, side: RobotSide, first: Snapshot, on_tick: Callable[[int], None]
) -> tuple[Outcome, list[m.Tick]]:
    """The task's own script in place of the servers: the same log, without queries, invocations or chunks."""
    ticks: list[m.Tick] = []
    snapshot, script = first, _script(side.environment)
    side._begin(info)
    side._show(first, 0)
    while snapshot.status is Status.ONGOING:
        values = next(script, None)
        if values is None:
            return Outcome(status=m.TaskStatus.ABORTED, reason="the oracle gave up", num_ticks=len(ticks)), ticks
        tick = len(ticks)
        due_ns = deadline_ns(0, tick, info.schedule.control_hz)
        action = m.Action(tick=tick, deadline_ns=due_ns, level=m.Level.PLAY, values=values)
        account = m.Tick(
            tick=tick, deadline_ns=due_ns, decided_ns=due_ns, late_ns=0, level=m.Level.PLAY, state=snapshot.state,
            action=values, raw_row=values, observation_tick=tick,
        )  # fmt: skip
        side.link.publish(ACTION, action, at_ns=due_ns)
        ticks.append(side.link.publish(TICK, account, at_ns=due_ns))
        snapshot = side._obey(info, action)
        side.recorder.step()
        on_tick(tick + 1)
    return Outcome(status=status_of(snapshot), reason=snapshot.reason, num_ticks=len(ticks)), ticks


def _script(environment: World) -> Iterator[m.Floats]:
    return iter(environment.oracle())
