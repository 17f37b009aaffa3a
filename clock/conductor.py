"""The schedule of one episode as a pure state machine: messages and instants in, messages out.

It decides when PONDER is queried, what POUNCE is given (invocation: reference, age, cognition), which row is played
at each tick, and what happens when there is none. It never reads a clock, sleeps or touches a bus, so real time and
lockstep are the same code: in lockstep the shell checks ``is_waiting`` and stops time meanwhile.

    WAIT_OBSERVATION -> WAIT_COGNITION -> WAIT_CHUNK -> RUNNING -> ENDED

As in the paper, control starts only after the first cognition; with WaitKind.HOLD, ticks run from the first observation
and hold the initial command until then. Without a PONDER (`policies`) nothing is awaited but the first chunk.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from clock.alarms import Alarms
from clock.asked import Asked, Request
from clock.commander import NO_ROW, Commander, Decision
from clock.delays import modelled_ns
from clock.dimensions import dimensions_of
from clock.ladder import Ladder
from clock.limits import Hit, out_of_range
from clock.playback import Chunk, Join, covering, deadline_ns, row_of, seam_policy, tick_at
from clock.policies import has_ponder
from clock.reference import Ready, latest_ready, refer, text_age_ns
from clock.residual import Due, ResidualHead, corrected
from clock.sight import Sight, unfit
from clock.timebase import NS_PER_S
from protocol.messages import (
    Action,
    ActionChunk,
    ActionSpace,
    Cognition,
    EpisodeInfo,
    Event,
    Floats,
    Invocation,
    Level,
    Mode,
    Observation,
    Query,
    RobotState,
    Severity,
    Stamp,
    StampKind,
    TaskStatus,
    Tick,
    WaitKind,
)

Effect = Query | Stamp | Invocation | Action | Tick | Event

_NO_CARRIERS: Floats = np.zeros((0, 0), np.float32)
_SKIPPED = Decision(command=NO_ROW, level=Level.SKIPPED, hit=Hit.NONE, chunk=None, seam_jump=0.0)
_STATE_MAX_AGE_NS = 200_000_000  # older joints do not say where a stopped arm is


class Stage(Enum):
    WAIT_OBSERVATION = "wait_observation"
    WAIT_COGNITION = "wait_cognition"
    WAIT_CHUNK = "wait_chunk"
    RUNNING = "running"
    ENDED = "ended"


@dataclass(slots=True)
class Conductor:
    """One episode's schedule. All instants are episode time.

    One state machine, because every event may change what is due next: a query, an invocation, the tick that is
    played, or the rung of the ladder.

    Attributes:
        info: the episode's terms, agreed when it was opened.
        committed_ticks: number of ticks that will be played whatever a new chunk contains; POUNCE receives it.
        residual: head that corrects every row with the newest joints; None: no correction.
        picture_ticks: offsets of the pictures that POUNCE looks at, against an invocation's tick.
        picture_stride_ticks: POUNCE also remembers the pictures of every n-th tick; 0: it does not.
        start_ns: deadline of tick 0, once known.
    """

    info: EpisodeInfo
    committed_ticks: int = 0
    residual: ResidualHead | None = None
    picture_ticks: tuple[int, ...] = (0,)
    picture_stride_ticks: int = 0
    stage: Stage = Stage.WAIT_OBSERVATION
    start_ns: int = 0
    tick: int = 0
    num_queries: int = 0
    num_invocations: int = 0
    _absent: set[str] = field(default_factory=set)
    _newest: Observation | None = None
    _ready: list[Ready] = field(default_factory=list)
    _cognitions: dict[int, Cognition] = field(default_factory=dict)
    _chunks: list[Chunk] = field(default_factory=list)
    _query_due_ns: int = 0
    _invoke_due_tick: int = 0
    _queried_tick: int = -1
    _queried_in: int = -1  # tick
    _invoked_in: int = -1
    _has_ponder: bool = field(init=False)
    _queries: Asked = field(init=False)
    _invocations: Asked = field(init=False)
    _alarms: Alarms = field(init=False)
    _sight: Sight = field(init=False)
    _join: Join = field(init=False)
    _commander: Commander = field(init=False)
    _query_rng: np.random.Generator = field(init=False)
    _invoke_rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self._has_ponder = has_ponder(self.info.policy)
        self._queries = Asked(StampKind.COGNITION, self._is_lockstep)
        self._invocations = Asked(StampKind.CHUNK, self._is_lockstep)
        self._alarms = Alarms(self.info)
        self._commander = Commander(self.info)
        self._sight = Sight(self.info.robot)
        self._join = seam_policy(self.info.schedule.seam, self._is_gripper_A)
        streams = np.random.SeedSequence(self.info.schedule.seed).spawn(2)
        self._query_rng, self._invoke_rng = (np.random.default_rng(s) for s in streams)

    # -- inputs

    def on_observation(self, observation: Observation) -> bool:
        """Takes an observation; returns False if a newer one is known."""
        if self._newest is not None and observation.tick < self._newest.tick:
            return False
        self._newest = observation
        self._sight.on_observation(observation)
        return True

    def on_cognition(self, cognition: Cognition, now_ns: int) -> bool:
        """Takes PONDER's answer; returns False if it was not asked for (late, duplicate, unknown)."""
        return self._queries.take(cognition.query, cognition, now_ns)

    def on_chunk(self, chunk: ActionChunk, now_ns: int) -> bool:
        """Takes POUNCE's answer; returns False if it was not asked for, or its shape, space or terms are wrong."""
        if (chunk.horizon, chunk.action_dim) != (self.info.schedule.horizon, self.info.robot.action_dim):
            return False
        if chunk.action_space != ActionSpace.JOINT_TARGET:
            return False
        asked = self._invocations.find(chunk.invocation, (chunk.t_row0, chunk.ref_query, chunk.age_ns))
        if asked is None:
            return False
        if len(dimensions_of(self.info.robot).deltas) and asked.state.tobytes() != chunk.reference_state.tobytes():
            return False
        return self._invocations.take(chunk.invocation, chunk, now_ns)

    def on_lost(self, proc: str) -> None:
        """Notes a lost server. In real time its pending answers will not come; in lockstep the world waits for it."""
        if self._is_lockstep:
            return
        self._absent.add(proc)
        (self._queries if proc == "ponder" else self._invocations).forget_unanswered()

    def on_back(self, proc: str) -> None:
        self._absent.discard(proc)

    @property
    def ladder(self) -> Ladder:
        return self._commander.ladder

    @property
    def last_command(self) -> Floats:
        return self._commander.last_command

    def engage(self, now_ns: int) -> str:
        """Allows motion again, from where the arm is; returns why not, or ""."""
        newest = self._newest
        if not self.ladder.is_latched:
            return f"the robot is not stopped: its level is {self.ladder.level.name}"
        if newest is None:
            return "no observation has come yet: nobody knows where the arm is"
        if not newest.robot_state.obeys:
            return f"the robot says {newest.robot_state.name} {newest.robot_text}".strip() + ": clear that first"
        if why_not := out_of_range(newest.proprio, self.info.robot):
            return why_not
        age_ns = now_ns - newest.source_ns
        if not self._is_lockstep and age_ns > _STATE_MAX_AGE_NS:
            limit_ms = _STATE_MAX_AGE_NS / 1e6
            return f"the newest observation is {age_ns / 1e6:.0f} ms old; at most {limit_ms:.0f} ms are allowed"
        self._commander.engage()
        return ""

    # -- outputs

    def poll(self, now_ns: int) -> list[Effect]:
        """Returns all messages that are due at ``now_ns``, in order."""
        effects: list[Effect] = []
        if self._newest is not None and self._newest.status != TaskStatus.ONGOING:
            self.stage = Stage.ENDED
        self._settle(now_ns, effects)
        if self.stage == Stage.WAIT_OBSERVATION and self._newest is not None:
            if self._has_ponder:
                self._ask_ponder(self._newest, effects)
            self._query_due_ns = self._newest.source_ns + self.info.schedule.query_period_ns
            self.stage = Stage.WAIT_COGNITION
            if self.info.schedule.wait == WaitKind.HOLD:
                self._start(now_ns)
        has_cognition = bool(self._ready) or not self._has_ponder
        if self.stage == Stage.WAIT_COGNITION and has_cognition and "pounce" not in self._absent:
            self._ask_pounce(0, now_ns, effects)
            self._invoke_due_tick = self.info.schedule.invoke_period_ticks
            self.stage = Stage.WAIT_CHUNK
        if self.stage == Stage.WAIT_CHUNK:
            self._settle(now_ns, effects)
            if self._chunks:
                self._start(now_ns)
            elif not self._is_lockstep and not self._invocations.is_busy(now_ns, self._overdue_ns):
                # The answer was lost or refused, or POUNCE died: ask again.
                self.stage = Stage.WAIT_COGNITION
        while self.stage == Stage.RUNNING and self.deadline_ns(self.tick) <= now_ns:
            if not self._run_tick(now_ns, effects):
                break
        return effects

    def next_ns(self, now_ns: int) -> int | None:
        """Latest instant at which ``poll`` has something to do; None if only a message can change anything."""
        if self.stage == Stage.RUNNING:
            return self.deadline_ns(self.tick)
        modelled = [a.due_ns for a in (*self._queries.waiting, *self._invocations.waiting) if a.delay_ns is not None]
        return min((due for due in modelled if due > now_ns), default=None)

    def will_look(self, tick: int) -> bool:
        """Whether a model may be asked about the observation of ``tick``, the next one; False only if surely not.

        In lockstep the schedule alone decides, so the robot need not render pictures that no model will read.
        """
        is_remembered = self.picture_stride_ticks > 0 and tick % self.picture_stride_ticks == 0
        if is_remembered or not self._is_lockstep or self.stage != Stage.RUNNING:
            return True
        if tick >= self._invoke_due_tick or (self._has_ponder and self.deadline_ns(tick) >= self._query_due_ns):
            return True
        ahead, period = self._invoke_due_tick - tick, self.info.schedule.invoke_period_ticks
        return any((ahead + offset) % period == 0 for offset in self.picture_ticks)  # of this invocation or a later one

    def is_waiting(self, now_ns: int) -> bool:
        """In lockstep: whether time must stop at ``now_ns`` because an answer or an observation is due."""
        if self._newest is None:
            return True
        if self.stage == Stage.RUNNING and self.deadline_ns(self.tick) <= now_ns and self._newest.tick < self.tick:
            return True
        return self._queries.is_owed_by(now_ns) or self._invocations.is_owed_by(now_ns)

    def deadline_ns(self, tick: int) -> int:
        return deadline_ns(self.start_ns, tick, self.info.schedule.control_hz)

    # -- internals

    @property
    def _is_gripper_A(self) -> NDArray[np.bool_]:
        return dimensions_of(self.info.robot).is_gripper_A

    @property
    def _is_lockstep(self) -> bool:
        return self.info.schedule.mode == Mode.LOCKSTEP

    @property
    def _overdue_ns(self) -> int:
        """Time after which an invocation is overdue: the previous chunk then still has rows to bridge another one."""
        schedule = self.info.schedule
        ticks = max(schedule.invoke_period_ticks, schedule.horizon - schedule.invoke_period_ticks)
        return ticks * NS_PER_S // schedule.control_hz

    @property
    def newest_tick(self) -> int:
        """Tick of the newest observation; 0 before the first."""
        return 0 if self._newest is None else self._newest.tick

    @property
    def newest_source_ns(self) -> int | None:
        """Instant of the newest observation."""
        return None if self._newest is None else self._newest.source_ns

    @property
    def owed_query(self) -> int | None:
        """The oldest query without an answer."""
        return self._queries.owed

    @property
    def owed_invocation(self) -> int | None:
        """The oldest invocation without a chunk."""
        return self._invocations.owed

    def _start(self, now_ns: int) -> None:
        self.stage, self.start_ns = Stage.RUNNING, now_ns

    def _run_tick(self, now_ns: int, effects: list[Effect]) -> bool:
        """One tick: ask PONDER, ask POUNCE, play. Returns False if it has to wait before one of them (lockstep).

        An answer that is ready at this instant counts in the same tick: tau_t + d_t <= tau_j includes equality.
        """
        if self._is_lockstep and self._newest is not None and self._newest.tick < self.tick:
            return False
        if not self._is_lockstep:
            self._skip_missed(now_ns, effects)
        if not self._settle(now_ns, effects):
            return False
        if self._queried_in < self.tick:
            self._queried_in = self.tick
            self._ask_ponder_if_due(effects)
        if not self._settle(now_ns, effects):
            return False
        if self._invoked_in < self.tick:
            self._invoked_in = self.tick
            self._ask_pounce_if_due(effects)
        if not self._settle(now_ns, effects):
            return False
        self._play(now_ns, effects)
        self.tick += 1
        return True

    def _settle(self, now_ns: int, effects: list[Effect]) -> bool:
        """Admits ready answers; returns False if one that must be ready by now has not come (lockstep)."""
        if self._is_lockstep and (self._queries.is_owed_by(now_ns) or self._invocations.is_owed_by(now_ns)):
            return False
        self._stamp_answers(now_ns, effects)
        return True

    def _skip_missed(self, now_ns: int, effects: list[Effect]) -> None:
        """Logs whole ticks as skipped that passed while the clock service stalled; they are not caught up."""
        newest = tick_at(self.start_ns, now_ns, self.info.schedule.control_hz)
        if newest > self.tick:
            effects += self._alarms.skipped(self.tick, newest)
        for tick in range(self.tick, newest):
            effects.append(self._account(tick, now_ns, _SKIPPED, NO_ROW))
        if newest > self.tick:
            self._commander.skip(newest - self.tick)
        self.tick = max(self.tick, newest)

    def _ask_ponder_if_due(self, effects: list[Effect]) -> None:
        tau_ns, newest = self.deadline_ns(self.tick), self._newest
        if not self._has_ponder:
            return
        if newest is not None and tau_ns >= self._query_due_ns and newest.tick > self._queried_tick:
            if "ponder" in self._absent:
                text = "PONDER is away: no queries until it is back"
                effects += self._alarms.once(self.tick, Severity.WARNING, "query_skipped", text)
            elif self._is_lockstep or not self._queries.is_busy(tau_ns, self.info.schedule.max_age_ns):
                self._ask_ponder(newest, effects)
                while self._query_due_ns <= tau_ns:
                    self._query_due_ns += self.info.schedule.query_period_ns

    def _ask_pounce_if_due(self, effects: list[Effect]) -> None:
        tau_ns = self.deadline_ns(self.tick)
        has_cognition = latest_ready(self._ready, tau_ns) is not None or not self._has_ponder
        if self.tick >= self._invoke_due_tick and has_cognition:
            if "pounce" in self._absent:
                text = "POUNCE is away: no invocations until it is back"
                effects += self._alarms.once(self.tick, Severity.WARNING, "invocation_skipped", text)
            elif self._is_lockstep or not self._invocations.is_busy(tau_ns, self._overdue_ns):
                if not self.num_invocations:  # after a hold: the period counts from the first invocation
                    self._invoke_due_tick = self.tick
                self._ask_pounce(self.tick, tau_ns, effects)
                while self._invoke_due_tick <= self.tick:
                    self._invoke_due_tick += self.info.schedule.invoke_period_ticks

    def _ask_ponder(self, observation: Observation, effects: list[Effect]) -> None:
        delay = modelled_ns(self.info.schedule.query_delay, self._query_rng)
        asked = Request(self.num_queries, observation.source_ns, delay)
        self._queries.add(asked)
        effects.append(Query(query=asked.index, tick=observation.tick, source_ns=observation.source_ns))
        self.num_queries += 1
        self._queried_tick = observation.tick

    def _ask_pounce(self, tick: int, tau_ns: int, effects: list[Effect]) -> None:
        reference = refer(self._ready, tau_ns, self.info.schedule.delivery)
        delay = modelled_ns(self.info.schedule.invoke_delay, self._invoke_rng)
        row0_tick = self._newest.tick if self._newest is not None else tick
        state = NO_ROW if self._newest is None else self._newest.proprio
        asked = Request(self.num_invocations, tau_ns, delay, (row0_tick, reference.query, reference.age_ns), state)
        self._invocations.add(asked)
        tail = self._unplayed_rows(tick)
        given = None if reference.query is None else self._cognitions[reference.query]
        effects.append(
            Invocation(
                invocation=asked.index,
                tick=row0_tick,
                now_ns=tau_ns,
                ref_query=reference.query,
                age_ns=reference.age_ns,
                cognition=_NO_CARRIERS if given is None else given.vector,
                seed=invocation_seed(self.info.schedule.seed, asked.index),
                previous_rows=tail.ravel(),
                committed_rows=min(self.committed_ticks, len(tail)),
                text=None if given is None else given.text,
                text_age_ns=0 if given is None else text_age_ns(given, tau_ns),
            )
        )
        self.num_invocations += 1

    def _unplayed_rows(self, tick: int) -> Floats:
        chunks = covering(self._chunks, tick)
        if not chunks:
            return np.zeros((0, self.info.robot.action_dim), np.float32)
        return chunks[-1].given_from(tick)

    def _stamp_answers(self, now_ns: int, effects: list[Effect]) -> None:
        """Admits every ready answer; the log's stamp is authoritative."""
        for asked, stamp in self._queries.ripe(now_ns):
            answer = asked.answer
            assert isinstance(answer, Cognition)
            self._ready.append(
                Ready(
                    query=stamp.index,
                    source_ns=stamp.source_ns,
                    ready_ns=stamp.ready_ns,
                    is_transition=answer.is_transition,
                )
            )
            self._cognitions[stamp.index] = answer
            self._forget_cognitions()
            effects.append(stamp)
        for asked, stamp in self._invocations.ripe(now_ns):
            answer = asked.answer
            assert isinstance(answer, ActionChunk)
            self._chunks.append(Chunk.of(answer, self.info.robot))
            effects.append(stamp)
        self._chunks = [c for c in self._chunks if c.t_row0 + len(c.rows_NA) > self.tick]

    def _forget_cognitions(self) -> None:
        """Keeps only cognitions that a delivery may refer to: the newest, the first, and the last two transitions'.

        Two, because the last one may have come after the tick's deadline and before this late poll.
        """
        transitions = [r.query for r in self._ready if r.is_transition]
        first = min(r.query for r in self._ready)  # an overdue answer may follow a later one
        keep = {first, *transitions[-2:], *(r.query for r in self._ready[-8:])}
        for query in self._cognitions.keys() - keep:
            del self._cognitions[query]

    def _play(self, now_ns: int, effects: list[Effect]) -> None:
        self._chunks = [c if c.first_tick is not None else replace(c, first_tick=self.tick) for c in self._chunks]
        usable = [c for c in covering(self._chunks, self.tick) if c.age_ns <= self.info.schedule.stale_limit_ns]
        newest, chunk, raw = self._newest, None, NO_ROW
        state = None if newest is None else newest.proprio
        robot_state = RobotState.UNSPECIFIED if newest is None else newest.robot_state
        if usable:
            chunk, row_A = usable[-1], self._join(usable, self.tick)
            known = self.last_command if state is None else state
            due = Due(row_A=row_A, state=known, row=self.tick - chunk.t_row0, age_ns=chunk.age_ns)
            raw = corrected(self.residual, due, self._is_gripper_A)
        before, was_playing = self.ladder.level, self.ladder.has_played
        state_ticks = self.tick - self.newest_tick
        sight = self._look(effects)
        decided = self._commander.step(raw, chunk, state, robot_state, state_ticks=state_ticks, sight=sight)
        effects += self._alarms.limits(self.tick, decided.hit, chunk, newest)
        effects += self._alarms.blocked(self.tick, is_blocked=self._commander.is_blocked)
        effects += self._alarms.robot(self.tick, robot_state, "" if newest is None else newest.robot_text)
        if decided.level != before and (was_playing or decided.level != Level.PLAY):
            effects += self._alarms.level(self.tick, before, decided.level)
        due_ns = self.deadline_ns(self.tick)
        effects.append(Action(tick=self.tick, deadline_ns=due_ns, level=decided.level, values=decided.command))
        effects.append(self._account(self.tick, now_ns, decided, raw))

    def _look(self, effects: list[Effect]) -> Hit:
        """Whether the pictures are a ground to move on at this tick; tells when that changes."""
        due_ns = self.deadline_ns(self.tick)
        age_ns, still_ns = self._sight.age_ns(due_ns), self._sight.still_ns(due_ns)
        hit = unfit(self.info.robot, age_ns, still_ns)
        effects += self._alarms.pictures(self.tick, hit, age_ns, still_ns)
        return hit

    def _account(self, tick: int, now_ns: int, decided: Decision, raw: Floats) -> Tick:
        due_ns, chunk = self.deadline_ns(tick), decided.chunk
        row = row_of(chunk, tick) if chunk is not None else None
        age_ns = self._sight.age_ns(due_ns)
        return Tick(
            tick=tick,
            deadline_ns=due_ns,
            decided_ns=now_ns,
            late_ns=now_ns - due_ns,
            level=decided.level,
            invocation=chunk.invocation if chunk is not None else None,
            t_row0=chunk.t_row0 if chunk is not None else 0,
            row=row or 0,
            ref_query=chunk.ref_query if chunk is not None else None,
            age_ns=chunk.age_ns if chunk is not None else 0,
            observation_tick=self._newest.tick if self._newest is not None else 0,
            state=self._newest.proprio if self._newest is not None else NO_ROW,
            action=decided.command,
            raw_row=raw,
            limits_hit=int(decided.hit),
            seam_jump=decided.seam_jump,
            age_ms=chunk.age_ns / 1e6 if chunk is not None else 0.0,
            late_ms=(now_ns - due_ns) / 1e6,
            robot_state=self._newest.robot_state if self._newest is not None else RobotState.UNSPECIFIED,
            picture_age_ns=age_ns,
            picture_still_ns=self._sight.still_ns(due_ns),
        )


def invocation_seed(episode_seed: int, invocation: int) -> int:
    """Seed of the flow noise, a function of the episode's seed and the invocation's number alone."""
    return int(np.random.SeedSequence([episode_seed, invocation]).generate_state(1, np.uint64)[0] >> 1)
