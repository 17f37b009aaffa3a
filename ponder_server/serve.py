"""The shell of ``ponder-serve``: drains the bus, runs the engine, publishes, and rebuilds a lost context."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator
from dataclasses import replace

from model_server.shell import ModelShell
from ponder_server.contract import ContextFull, EngineSpec, Fire, Opening, PonderEngine, SessionError
from ponder_server.node import PonderNode, Work, check_robot
from protocol import codec, images, topics
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import CallFailed, EpisodeRefused, MalformedMessage, ProtocolError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id

log = logging.getLogger(__name__)


class PonderServer(ModelShell):
    """PONDER on a bus."""

    def __init__(self, link: Link, engine: PonderEngine, heartbeat: Heartbeat, version: str) -> None:
        super().__init__(link, engine, heartbeat, version)
        self._engine = engine
        self._node = PonderNode(engine.spec)
        self._queries = link.subscribe(topics.QUERY)
        self._last: m.Cognition | None = None
        self._num_left_out = 0

    @property
    def num_superseded(self) -> int:
        return self._node.num_superseded

    def _weights_note(self) -> str:
        spec = self._engine.spec
        if spec.weights == "float":
            return ""
        return f"{spec.weights} weights: relative L2 change of cognition {spec.cognition_error:.1e} at start"

    def step(self) -> bool:
        worked = self._take_calls()
        worked |= self._listen()
        work = self._next_work()
        if work is not None:
            self._fire(work)
        return worked or work is not None or self._resume()

    def _listen(self) -> bool:
        """Reads all pending messages; returns whether one led to an episode."""
        self._heartbeat.beat()
        worked = False
        self._take_observations()
        for query in self._queries.drain():
            if query.header.episode != self._link.episode:
                worked |= self.rejoin()  # unknown episode: this process restarted, or another one opened it
            if self._link.is_from(query.header, "clock"):
                self._link.survive("query", self._node.on_query, query)
        missed = self._node.missed()
        for query in missed:
            self._tell(m.Severity.ERROR, "observation_missed", f"query {query.query}: tick {query.tick} never came")
        has_hole = bool(missed) or self._node.num_superseded > self._num_left_out
        if self._is_shadow and has_hole and not self._engine.spec.answers_newest:
            self._tell(m.Severity.WARNING, "shadow_left", "it did not keep up: its context would have a hole")
            self._membership.leave()
        self._num_left_out = self._node.num_superseded
        return worked

    def _next_work(self) -> Work | None:
        while True:
            try:
                return self._node.next_work()
            except MalformedMessage as error:
                self._link.drop("observation", DropReason.NO_PICTURE, str(error))

    def _on_observation(self, observation: m.Observation) -> None:
        self._node.on_observation(observation)

    def rejoin(self) -> bool:
        """After a restart: asks for the episode and its past queries with their observations, and reruns them."""
        rejoined = self._membership.rejoin()
        if rejoined is None:
            return False
        self._node.open(next_query=rejoined.num_queries, is_live=_is_live(rejoined.open))
        self._take_newest(rejoined)
        try:
            for work in self._missed_work(rejoined.num_queries, self._first_missed(rejoined)):
                if self._is_shadow or work.query.query == rejoined.owed_query:
                    self._fire(work)  # the log waits for each, or the clock still waits for this one (lockstep)
                else:
                    self._node.keep(work.query, self._think(work))
        except (CallFailed, ProtocolError, ContextFull) as error:
            self._give_up(error)
            return False
        self._rebuilt(rejoined.num_queries)
        return True

    def _resume(self) -> bool:
        """Takes the query that the clock waits for although it did not arrive, or sends its answer again."""
        owed = None if self._is_shadow else self._membership.owed()
        if owed is None or owed.owed_query is None:
            return False
        if self._last is not None and self._last.query == owed.owed_query:
            self._link.publish(topics.COGNITION, self._last, at_ns=time.monotonic_ns(), clock_id=host_clock_id())
            return True
        try:
            (entry,) = self._membership.journal(owed.owed_query + 1, first=owed.owed_query)
            self._take(codec.decode(m.Observation, entry.observation))
        except (CallFailed, ProtocolError, ValueError) as error:
            log.error("query %d: %s", owed.owed_query, error)
            return False
        self._node.on_query(m.Query(query=entry.query, tick=entry.tick, source_ns=entry.source_ns))
        return True

    def _first_missed(self, rejoined: m.ActiveReply) -> int:
        """The first query that a rebuild takes: 0, or with ``answers_newest`` the one that the clock awaits."""
        if not self._engine.spec.answers_newest:
            return 0
        is_awaited = rejoined.owed_query is not None and not _is_live(rejoined.open)
        return rejoined.owed_query if is_awaited else rejoined.num_queries  # type: ignore[return-value]

    def _missed_work(self, num_queries: int, first: int = 0) -> Iterator[Work]:
        """Queries of the running episode up to ``num_queries``, from the clock service's journal.

        Raises:
            CallFailed, ProtocolError: the clock service does not answer, or not with the requested queries.
        """
        for entry in self._membership.journal(num_queries, first):
            query = m.Query(query=entry.query, tick=entry.tick, source_ns=entry.source_ns)
            yield self._node.replay(query, codec.decode(m.Observation, entry.observation))

    def _rebuilt(self, num_queries: int) -> None:
        self._heartbeat.set(next_index=num_queries)
        self._membership.announce()
        if not self._is_shadow:  # it has just come, and had no other context
            self._tell(
                m.Severity.INFO, "context_rebuilt", f"PONDER rebuilt its context from {num_queries} observations"
            )

    def _give_up(self, error: Exception) -> None:
        """Leaves an episode whose context cannot be rebuilt."""
        log.error("rebuild failed episode=%s %s", self._link.episode, error)
        self._close()
        self._link.leave_episode()

    def _fire(self, work: Work) -> None:
        with self._inferring("fire") as start_ns:
            try:
                fire = self._think(work)
            except (ContextFull, SessionError, ValueError) as error:
                self._refuse(work, error)
            else:
                self._answer(work, fire, start_ns)

    def _beat(self) -> None:
        """The heartbeat of whoever waits while this server works."""
        self._heartbeat.beat()

    def _think(self, work: Work) -> Fire:
        return self._engine.fire(self._link.episode, work.frames, self._heartbeat.beat, proprio=work.proprio)

    def _refuse(self, work: Work, error: Exception) -> None:
        """Reports a query that the engine refused, unchanged. Without an answer cognition ages, and the ladder acts."""
        self._tell(m.Severity.ERROR, "fire_refused", f"query {work.query.query}: {error}")

    def _answer(self, work: Work, fire: Fire, start_ns: int) -> None:
        ready_ns = time.monotonic_ns()
        if self._last is None and self._engine.spec.introduction:
            self._tell(m.Severity.INFO, "ponder_is", self._engine.spec.introduction)
        if fire.trouble:
            self._tell(m.Severity.WARNING, "no_reply", f"query {work.query.query}: {fire.trouble}")
        cognition, subgoals = self._node.answer(work, fire, ready_ns=ready_ns, infer_ns=ready_ns - start_ns)
        topic = topics.SHADOW_COGNITION if self._is_shadow else topics.COGNITION
        self._last = self._link.publish(topic, cognition, at_ns=ready_ns, clock_id=host_clock_id())
        for subgoal in () if self._is_shadow else subgoals:  # readers of texts take those of the PONDER that is used
            self._link.publish(topics.SUBGOAL, subgoal, at_ns=ready_ns, clock_id=host_clock_id())
        self._answered(self._node.next_query)

    def _contract(self) -> m.Contract:
        spec = self._engine.spec
        return m.Contract(
            proc="ponder",
            num_carriers=spec.num_carriers,
            hidden_size=spec.hidden_size,
            preferred_codec=images.wire_codec(self._link.bus.is_local),
            infer_p50_ns=self._heartbeat.health.infer_p50_ns,
            infer_p99_ns=self._heartbeat.health.infer_p99_ns,
            model_hash=spec.model_hash,
            is_fake=spec.is_fake,
            version=self._version,
            max_context_tokens=spec.max_context_tokens,
            demonstrations=m.DemoSampling(hz=spec.demonstrations.hz, to_its_end=spec.demonstrations.to_its_end),
            channels=_channels(spec),
        )

    def _open(self, request: m.OpenRequest) -> m.Contract:
        check_robot(request.info.robot, self._engine.spec)
        demo = []
        for frame in request.demo:
            demo.append(tuple(images.unpack(image) for image in frame.images))
            self._beat()  # six hundred pictures take seconds
        opening = Opening(instruction=request.info.instruction, demo_frames=tuple(demo))
        try:
            context_tokens = self._engine.open(self._link.episode, opening, self._heartbeat.beat)
        except SessionError as error:
            raise EpisodeRefused(m.Refusal.BUSY, str(error)) from error
        self._node.open(is_live=_is_live(request))
        return replace(self._contract(), context_tokens=context_tokens)

    def _close(self) -> None:
        with contextlib.suppress(SessionError):  # the engine may have refused to open it
            self._engine.close(self._link.episode)
        self._node.open()
        self._last = None


def _is_live(opened: m.OpenRequest | None) -> bool:
    return opened is not None and opened.info.schedule.mode == m.Mode.REALTIME


def _channels(spec: EngineSpec) -> tuple[m.ChannelSpec, ...]:
    vectors = [m.PayloadKind.VECTORS] if spec.num_carriers else []
    texts = [m.PayloadKind.TEXT] if spec.gives_text else []
    return tuple(m.ChannelSpec(payload=payload) for payload in (*vectors, *texts))
