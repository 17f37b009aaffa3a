"""The clock service: the shell around the conductor, embedded in ``sim-client`` or running as ``clock-serve``.

It is the authority on time: it opens the episode at both model servers, checks that they fit and that the schedule is
feasible, issues every instant, monitors the other processes, and keeps the journal from which a restarted PONDER
rebuilds its context. It has one thread; nothing here blocks while an episode runs.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from clock.agreement import agree
from clock.channels import null_of
from clock.conductor import Conductor, Stage
from clock.episode import Episode
from clock.policies import SERVERS, has_ponder, servers_of
from clock.report import ADMITTED_EVENT
from clock.residual import RESIDUAL_EVENT, ResidualHead
from clock.servers import Servers
from clock.timebase import MonotonicClock, VirtualClock
from clock.watch import HEARTBEAT_TIMEOUT_NS, Watch
from protocol import codec
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import CallFailed, EpisodeRefused, ProtocolError
from protocol.link import Link, Service, source_of
from protocol.process import host_clock_id
from protocol.topics import (
    ACTION,
    ACTIVE,
    CHUNK,
    CLOSE,
    COGNITION,
    ENGAGE,
    EVENT,
    HEALTH,
    INFO,
    INVOCATION,
    JOURNAL,
    OBSERVATION,
    OPEN,
    PHASE,
    QUERY,
    SHADOW_OF,
    STAMP,
    TICK,
    TIME,
    Topic,
    alive_key,
)

log = logging.getLogger(__name__)

ROBOT = "sim"
ROBOT_SILENCE_NS = 1_000_000_000
MAX_SHADOW_QUERIES = 4  # for later ones it would fetch a journal from this thread, while rows are played
_TOPIC_OF: dict[type, Topic[object]] = {
    t.cls: t  # type: ignore[misc]
    for t in (QUERY, STAMP, INVOCATION, ACTION, TICK, EVENT)
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceConfig:
    """Options of the clock service."""

    allow_starved: bool = False
    """Start although d <= s <= H - d fails; starved ticks hold the last command and are counted."""
    max_clock_bound_ns: int = 5_000_000
    """Largest accepted uncertainty of another host's clock offset; beyond it no episode starts."""
    heartbeat_timeout_ns: int = HEARTBEAT_TIMEOUT_NS
    residual: ResidualHead | None = None
    """Residual head that corrects every row at 20 Hz."""
    journal_limit_bytes: int = 2 << 30
    """Limit of the observations kept for a restarted PONDER; beyond it a rejoin is refused and the ladder acts."""
    servers: tuple[str, ...] = SERVERS
    """Servers without which this clock does not call itself ready; an episode names its own."""
    watches: bool = True
    """False if all participants share one thread, so that none can die alone."""


class ClockService:
    """One robot's clock. ``step`` does due work and returns whether there was any; ``wait_ns`` is the time to wait.

    One class, because calls and streams meet in one episode: a call opens or closes it, and the open episode decides
    what every message means.

    Attributes:
        models: hashes of the newest episode's models, PONDER's and POUNCE's with a "+" between; "" before the first.
    """

    def __init__(self, link: Link, config: ServiceConfig, *, host_clock: MonotonicClock | None = None) -> None:
        self._link = link
        self._config = config
        self._host = host_clock or MonotonicClock(zero_ns=0)
        self._watch = Watch(timeout_ns=config.heartbeat_timeout_ns)
        self._servers = Servers(
            link=link,
            host=self._host,
            watch=self._watch,
            watches=config.watches,
            max_clock_bound_ns=config.max_clock_bound_ns,
        )
        self._episode: Episode | None = None
        self._last_epoch: dict[str, int] = {}
        self._is_stepping = False
        self._is_draining = False
        self._robot_heard_ns = 0
        self.models = ""
        self._observations = link.subscribe(OBSERVATION, keep=8)
        self._cognitions = link.subscribe(COGNITION)
        self._chunks = link.subscribe(CHUNK)
        self._healths = link.subscribe(HEALTH)
        self._tokens = link.bus.watch_alive(alive_key(link.robot, "*"))
        self._services: list[tuple[Service, Callable[[Any], Any]]] = [
            (link.serve(OPEN), self.open),
            (link.serve(CLOSE), self.close),
            (link.serve(ACTIVE), self._on_active),
            (link.serve(JOURNAL), self._on_journal),
            (link.serve(TIME), self._on_time),
            (link.serve(ENGAGE), self._on_engage),
        ]
        link.bus.declare_alive(alive_key(link.robot, link.proc))

    @property
    def conductor(self) -> Conductor | None:
        return self._episode.conductor if self._episode else None

    def wait_ns(self, longest_ns: int) -> int:
        """Time until something is due if no message comes, at most ``longest_ns``."""
        episode = self._episode
        due_ns = episode.conductor.next_ns(episode.now_ns) if episode and episode.clock else None
        if episode is None or due_ns is None or episode.is_lockstep:
            return longest_ns
        return max(0, min(longest_ns, due_ns - episode.now_ns))

    def drain(self) -> bool:
        """Opens no more episodes from now on; returns whether none runs."""
        if not self._is_draining:
            log.info("draining robot=%s episode=%s", self._link.robot, self._link.episode or "none")
        self._is_draining = True
        return self._episode is None

    def step(self) -> bool:
        if self._is_stepping:  # re-entered while waiting for a server on a LocalBus
            return False
        self._is_stepping = True
        try:
            worked = self._take_messages()  # first: the last words of a server count although its successor asks
            worked |= any([service.answer(handler) > 0 for service, handler in self._services])  # a list: all answer
            self._check_liveness()
            return self._conduct() or worked
        finally:
            self._is_stepping = False

    # -- inputs

    def _take_messages(self) -> bool:
        worked = False
        for health in self._healths.drain():
            self._watch.on_health(health, self._host.now_ns())
        for sample in self._tokens.drain():
            self._watch.on_token(sample.key.rpartition("/")[2], bool(sample.payload))
        episode = self._episode
        for observation, sample in self._observations.receive():
            if episode is not None and self._link.is_from(observation.header, ROBOT):
                source = source_of(observation.header)
                worked |= bool(self._link.survive(source, self._on_observation, episode, observation, sample.payload))
        for cognition in self._cognitions.drain():
            if episode is not None and self._link.is_from(cognition.header, "ponder"):
                worked |= bool(self._link.survive(source_of(cognition.header), self._on_cognition, episode, cognition))
        for chunk in self._chunks.drain():
            if episode is not None and self._link.is_from(chunk.header, "pounce"):
                worked |= bool(self._link.survive(source_of(chunk.header), self._on_chunk, episode, chunk))
        if episode is not None and self._link.second_sender:  # nobody can say which of the two is meant
            self._event(m.Severity.ERROR, DropReason.SECOND_SENDER, f"the episode is over: {self._link.second_sender}")
            self._finish(None)
        return worked

    def _on_cognition(self, episode: Episode, cognition: m.Cognition) -> bool:
        contract = episode.contracts.get("ponder")
        if contract is None or not self._is_agreed(episode, "ponder", cognition):
            return False
        expected = (contract.num_carriers, contract.hidden_size) if contract.num_carriers else (0, 0)
        if cognition.vector.shape != expected:
            detail = f"expected a cognition of {expected}, came {cognition.vector.shape}"
            self._link.drop(source_of(cognition.header), DropReason.WRONG_SHAPE, detail)
            return False
        taken = episode.conductor.on_cognition(cognition, episode.now_ns)
        return taken or self._unasked("cognition", cognition.query, cognition.header)

    def _on_chunk(self, episode: Episode, chunk: m.ActionChunk) -> bool:
        if not self._is_agreed(episode, "pounce", chunk):
            return False
        taken = episode.conductor.on_chunk(chunk, episode.now_ns)
        return taken or self._unasked("chunk", chunk.invocation, chunk.header)

    def _is_agreed(self, episode: Episode, proc: str, answer: m.Cognition | m.ActionChunk) -> bool:
        """Whether an answer is from the model that the episode was opened with; another one is never played."""
        contract = episode.contracts.get(proc)
        if contract is None:
            return False
        if (answer.model_hash, answer.is_fake) == (contract.model_hash, contract.is_fake):
            return True
        header, agreed = answer.header, _named(contract.model_hash, contract.is_fake)
        came = _named(answer.model_hash, answer.is_fake)
        self._link.drop(source_of(header), DropReason.OTHER_MODEL, f"the episode was opened with {agreed}, came {came}")
        if header.boot_id not in episode.others and len(episode.others) < 16:
            episode.others.add(header.boot_id)
            text = f"{proc} answers with another model, {came}; the episode has {agreed}: its answers are not played"
            self._event(m.Severity.ERROR, "other_model", text)
        return False

    def _on_observation(self, episode: Episode, observation: m.Observation, payload: bytes) -> bool:
        if len(observation.proprio) != episode.request.info.robot.num_proprio:
            expected = episode.request.info.robot.num_proprio
            detail = f"expected {expected} joints, came {len(observation.proprio)}"
            self._link.drop(observation.header.proc, DropReason.WRONG_SHAPE, detail)
            return False
        if observation.header.clock_id != m.EPISODE_CLOCK:
            offset = self._servers.offsets.get(observation.header.proc)
            if offset is None:
                self._link.drop(observation.header.proc, DropReason.UNKNOWN_CLOCK, observation.header.clock_id)
                return False
            zero_ns = episode.clock.zero_ns if isinstance(episode.clock, MonotonicClock) else self._host.now_ns()
            captured_ns = tuple(offset.to_ours(at_ns) - zero_ns for at_ns in observation.captured_ns)
            source_ns = offset.to_ours(observation.source_ns) - zero_ns
            observation = replace(observation, source_ns=source_ns, captured_ns=captured_ns)
        if why_not := episode.out_of_time(observation):
            self._link.drop(source_of(observation.header), DropReason.WRONG_INSTANT, why_not)
            return False
        self._robot_heard_ns = self._host.now_ns()
        if episode.clock is None:
            episode.clock = VirtualClock() if episode.is_lockstep else MonotonicClock()
        if episode.conductor.on_observation(observation):
            episode.show(observation.tick, payload)
        return True

    def _unasked(self, what: str, index: int, header: m.Header) -> bool:
        self._link.drop(source_of(header), DropReason.UNASKED, f"{what} {index}")
        return False

    def _check_liveness(self) -> None:
        """Detects lost and returned servers; a lost robot ends the episode."""
        episode = self._episode
        if episode is None or not self._config.watches:
            return
        for change in self._watch.poll(episode.servers, self._link.episode, self._host.now_ns()):
            if change.is_lost:
                episode.conductor.on_lost(change.proc)
                self._event(m.Severity.ERROR, f"{change.proc}_lost", f"{change.proc} is lost: {change.why}")
            else:
                episode.conductor.on_back(change.proc)
                self._event(m.Severity.INFO, f"{change.proc}_back", f"{change.proc} is back: {change.why}")
        if self._is_robot_gone():
            self._event(m.Severity.ERROR, "sim_lost", "the robot side is gone: the episode is over")
            self._finish(None)

    def _is_robot_gone(self) -> bool:
        silent_ns = self._host.now_ns() - self._robot_heard_ns
        return self._watch.is_gone(ROBOT) and silent_ns > ROBOT_SILENCE_NS  # a starved process loses its token first

    # -- outputs

    def _conduct(self) -> bool:
        episode = self._episode
        if episode is None or episode.clock is None:
            return False
        now_ns = episode.now_ns
        try:
            effects = episode.conductor.poll(now_ns)
        except Exception as error:  # a bug: without commands the robot's side holds and ends the episode
            log.exception("the schedule failed episode=%s", self._link.episode)
            self._event(m.Severity.ERROR, "schedule_failed", f"the episode is over: {error!r}"[:1000])
            self._finish(None)
            return True
        for effect in effects:
            if isinstance(effect, m.Query):
                episode.keep(effect)
            sent = self._link.publish(_TOPIC_OF[type(effect)], effect, at_ns=now_ns)
            if isinstance(sent, m.Invocation):
                episode.invoked = sent
        self._show_phase(episode, now_ns)
        if isinstance(episode.clock, VirtualClock) and not episode.conductor.is_waiting(now_ns):
            due_ns = episode.conductor.next_ns(now_ns)
            if due_ns is not None and due_ns > now_ns:
                episode.clock.advance_to(due_ns)
                return True
        return bool(effects)

    def _show_phase(self, episode: Episode, now_ns: int) -> None:
        stage = episode.conductor.stage
        state = episode.conductor.ladder.level.name.lower() if stage == Stage.RUNNING else stage.value
        if state != episode.phase:
            episode.phase = state
            self._link.publish(PHASE, m.Phase(state=state), at_ns=now_ns)

    def _event(self, severity: m.Severity, name: str, text: str, **attributes: str) -> None:
        log.log(logging.WARNING if severity > m.Severity.INFO else logging.INFO, "event name=%s %s", name, text)
        episode = self._episode
        tick = episode.conductor.tick if episode else 0
        event = m.Event(severity=severity, name=name, text=text, tick=tick, attributes=attributes)
        self._link.publish(EVENT, event, at_ns=episode.now_ns if episode else 0)

    # -- calls

    def open(self, request: m.OpenRequest) -> m.OpenReply:
        """Opens an episode at both servers, or replies with the reason; ``try_again`` if it may be temporary."""
        info = request.info
        header = info.header
        if header.epoch <= self._last_epoch.get(header.session, 0):
            last = self._last_epoch[header.session]
            error = f"epoch {header.epoch} of session {header.session} is not after {last}"
            return m.OpenReply(error=error, refusal=m.Refusal.REQUEST)
        if self._episode is not None and self._link.members[ROBOT] != header.boot_id:
            error = f"robot {self._link.robot} is busy with episode {self._link.episode}"
            return m.OpenReply(error=error, refusal=m.Refusal.BUSY, try_again=True)
        if self._episode is not None:
            self._finish(None)  # the same robot restarts: abandon its old episode
        if self._is_draining:
            error = "the clock service is draining: it leaves now, and another process takes its place"
            return m.OpenReply(error=error, refusal=m.Refusal.NOT_READY, try_again=True)
        procs = servers_of(info.policy)
        if not procs:
            return self._begin(request, contracts=(), warnings=(), committed_ticks=0)
        if self._config.watches and (not_ready := self._servers.not_ready(procs)):
            return m.OpenReply(error=not_ready, refusal=m.Refusal.NOT_READY, try_again=True)
        try:
            self._enter(header)
            self._servers.measure_offsets(procs if info.robot.is_simulated else (*procs, ROBOT))
            contracts = tuple(self._servers.open(proc, request) for proc in procs)
            warnings, committed_ticks = agree(
                info, contracts, residual=self._config.residual, allow_starved=self._config.allow_starved
            )
        except (CallFailed, ProtocolError) as error:
            self._servers.close(procs, None)
            self._link.leave_episode()
            if isinstance(error, EpisodeRefused):
                return m.OpenReply(error=str(error), refusal=error.refusal, try_again=error.try_again)
            may_be_lost = isinstance(error, CallFailed) and self._config.watches  # the next opening sees it
            return m.OpenReply(error=str(error), try_again=may_be_lost)
        return self._begin(request, contracts, warnings, committed_ticks)

    def _begin(
        self, request: m.OpenRequest, contracts: Sequence[m.Contract], warnings: Sequence[str], committed_ticks: int
    ) -> m.OpenReply:
        header = request.info.header
        if not contracts:
            self._enter(header)
        self._last_epoch[header.session] = header.epoch
        self.models = "+".join(contract.model_hash for contract in contracts)
        procs = servers_of(request.info.policy)
        head = self._config.residual if procs else None
        window = contracts[-1].window or m.ObservationWindow() if contracts else m.ObservationWindow()
        conductor = Conductor(
            request.info,
            committed_ticks=committed_ticks,
            residual=head,
            picture_ticks=window.video_ticks,
            picture_stride_ticks=window.stride_ticks,
        )
        self._episode = Episode(request, conductor, contracts=dict(zip(procs, contracts, strict=True)))
        if self._episode.is_lockstep:  # in real time a restarted POUNCE has seen its window before it is warm
            self._episode.recent = deque(maxlen=window.reach_ticks)
        self._robot_heard_ns = self._host.now_ns()
        members = {proc: self._link.members[proc] for proc in procs}
        self._watch.enter(members, self._robot_heard_ns)
        self._link.publish(INFO, request.info, at_ns=0)
        if head is not None:
            text = f"every row is corrected by {head.digest}"
            self._event(m.Severity.INFO, RESIDUAL_EVENT, text, digest=head.digest)
        if procs and not has_ponder(request.info.policy):
            self._event(m.Severity.INFO, "no_ponder", f"POUNCE plays alone: it reads {null_of(contracts[0])}")
        for warning in warnings:
            self._event(m.Severity.WARNING, "warning", warning)
        for proc, offset in self._servers.offsets.items():
            text = f"{proc}: {offset.offset_ns / 1e6:+.3f} ms, known to {offset.bound_ns / 1e6:.3f} ms"
            self._event(m.Severity.INFO, "clock_offset", text, proc=proc)
        return m.OpenReply(contracts=tuple(contracts), warnings=tuple(warnings), members=self._servers.members())

    def _enter(self, header: m.Header) -> None:
        robot = m.Member(proc=ROBOT, boot_id=header.boot_id)
        self._link.enter_episode(header.session, header.episode, header.epoch, (robot,))

    def not_ready(self) -> str:
        """Why no episode of the configured servers can be opened, unless one runs already; "" if one can."""
        return self._servers.not_ready(self._config.servers)

    def close(self, request: m.CloseRequest) -> m.CloseReply:
        """Ends the episode here and at the servers."""
        if self._episode is None or request.header.episode != self._link.episode:
            return m.CloseReply(error=f"episode {request.header.episode!r} is not open here")
        if not self._link.is_from(request.header, ROBOT):
            return m.CloseReply(error="only the robot that opened an episode can close it")
        self._finish(request.result)
        return m.CloseReply()

    def _finish(self, result: m.EpisodeResult | None) -> None:
        episode, self._episode = self._episode, None  # first, so that a server with a late query cannot rejoin it
        if episode is not None:
            self._servers.close(episode.servers, result)
        self._watch.enter({}, self._host.now_ns())  # a server that restarts between episodes is not lost
        self._link.leave_episode()

    def _on_active(self, request: m.ActiveRequest) -> m.ActiveReply:
        if self._episode is None or self._plays_without(request.header.proc):
            return m.ActiveReply()
        if self._episode.journal_bytes > self._config.journal_limit_bytes:
            return m.ActiveReply(error="the journal of this episode outgrew its limit: its context cannot be rebuilt")
        if why_not := self._admit(request.header):
            return m.ActiveReply(error=why_not)
        conductor, invoked, opened = self._episode.conductor, self._episode.invoked, self._episode.request
        if request.header.proc == "pounce-shadow" and not conductor.picture_stride_ticks:
            opened = replace(opened, demo=())  # megabytes that this POUNCE does not read, while rows are played
        is_owed = invoked is not None and invoked.invocation == conductor.owed_invocation
        return m.ActiveReply(
            open=replace(opened, members=self._servers.members()),
            num_queries=len(self._episode.journal),
            owed_query=conductor.owed_query,
            owed_invocation=codec.encode(invoked) if is_owed else b"",
            observation=self._episode.newest_payload,
            recent=self._episode.past() if request.header.proc != "ponder" else (),
        )

    def _plays_without(self, proc: str) -> bool:
        """Whether this server has no part in the running episode."""
        return self._episode is not None and proc in set(SERVERS) - set(self._episode.servers)

    def _admit(self, asking: m.Header) -> str:
        """Lets a restarted server take the place of the one that is lost; returns why not, or ""."""
        proc = asking.proc
        if proc in SHADOW_OF:
            return self._admit_shadow(asking)
        if proc not in SERVERS:
            return f"{proc} has no part in an episode; expected {' or '.join(SERVERS)}"
        if self._link.members[proc] == asking.boot_id:
            return ""
        if self._config.watches and not self._watch.is_lost(proc):
            return f"the {proc} of episode {self._link.episode} is there: {asking.boot_id} is a second one"
        self._link.admit(m.Member(proc=proc, boot_id=asking.boot_id))
        self._watch.members[proc] = asking.boot_id
        text = f"{source_of(asking)} takes the place of the {proc} that is lost"
        self._event(m.Severity.INFO, ADMITTED_EVENT, text, proc=proc, boot_id=str(asking.boot_id))
        return ""

    def _admit_shadow(self, asking: m.Header) -> str:
        """Lets a process be heard by the log, and by nothing here. It costs this thread one early reply."""
        proc, episode = asking.proc, self._episode
        assert episode is not None
        if self._watch.has_rival(proc, self._host.now_ns()):
            return f"two processes answer to the name of {proc}: stop one of them"
        if SHADOW_OF[proc] not in episode.servers:
            return f"there is no {SHADOW_OF[proc]} in this episode"
        if SHADOW_OF[proc] == "ponder" and len(episode.journal) > MAX_SHADOW_QUERIES:
            return f"query {len(episode.journal)}: a PONDER stands behind another from the beginning; the next episode"
        if self._link.members.get(proc) != asking.boot_id:
            self._link.admit(m.Member(proc=proc, boot_id=asking.boot_id))
            text = f"{source_of(asking)} is asked like {SHADOW_OF[proc]}, and its answers are never used"
            self._event(m.Severity.INFO, ADMITTED_EVENT, text, proc=proc, boot_id=str(asking.boot_id))
        return ""

    def _on_journal(self, request: m.JournalRequest) -> m.JournalReply:
        if self._episode is None or not self._link.is_member(request.header):
            return m.JournalReply(
                error=f"episode {request.header.episode!r} is not open here for {request.header.proc}"
            )
        first = request.first_query
        return m.JournalReply(entries=tuple(self._episode.journal[first : first + request.max_queries]))

    def _on_time(self, request: m.TimeRequest) -> m.TimeReply:
        now_ns = self._host.now_ns()
        return m.TimeReply(clock_id=host_clock_id(), t1_ns=now_ns, t2_ns=now_ns)

    def _on_engage(self, request: m.EngageRequest) -> m.EngageReply:
        if self._episode is None:
            return m.EngageReply(error="no episode is open")
        if why_not := self._episode.conductor.engage(self._episode.now_ns):
            return m.EngageReply(error=why_not)
        self._event(m.Severity.WARNING, "engaged", f"motion may start again, says {request.operator}")
        return m.EngageReply(level=self._episode.conductor.ladder.level.name)


def _named(model_hash: str, is_fake: bool) -> str:
    return f"{model_hash or 'weights without a hash'}{' (untrained)' if is_fake else ''}"
