"""The shell of ``pounce-serve``: drains the bus, runs the engine, publishes chunks."""

from __future__ import annotations

import logging
import time

from clock.feasibility import delay_ticks
from clock.membership import Membership, percentile_ns
from pounce_server.contract import PounceEngine, check_robot
from pounce_server.node import PounceNode, Work
from pounce_server.told import Source, Told
from protocol import images, topics
from protocol import messages as m
from protocol.errors import MalformedMessage
from protocol.heartbeat import Heartbeat
from protocol.link import Link, is_of_episode
from protocol.process import host_clock_id

log = logging.getLogger(__name__)


class PounceServer:
    """POUNCE on a bus. ``step`` does one piece of work and says whether there was any."""

    def __init__(
        self, link: Link, engine: PounceEngine, heartbeat: Heartbeat, version: str, subgoals: Source | None = None
    ) -> None:
        """``subgoals``: whose texts an engine that reads them is told; see `told`."""
        self._link = link
        self._engine = engine
        self._heartbeat = heartbeat
        self._version = version
        self._is_told = subgoals is not None
        self._node = PounceNode(engine.spec, None if subgoals is None else Told(subgoals))
        self._membership = Membership(link, heartbeat, self._open, self._close)
        self._observations = link.subscribe(topics.OBSERVATION, keep=8)
        self._invocations = link.subscribe(topics.INVOCATION)
        self._subgoals = link.subscribe(topics.SUBGOAL) if self._is_told else None

    def warm_up(self) -> None:
        """Measures the engine: its p99 decides whether a schedule can be kept."""
        self._heartbeat.set(state=m.ServingState.WARMING)
        durations_ns = self._engine.warm_up()
        spec = self._engine.spec
        self._heartbeat.set(
            infer_p50_ns=percentile_ns(durations_ns, 50),
            infer_p99_ns=percentile_ns(durations_ns, 99),
            model_hash=spec.model_hash,
            is_fake=spec.is_random or spec.has_fresh_prefix,
            progress=1.0,
        )
        if spec.weights != "float":
            told = f"{spec.weights} weights: mean error of the normalised actions {spec.action_error:.1e}"
            self._heartbeat.set(detail=told)
            log.info("%s", told)

    def ready(self) -> None:
        """Joins a running episode, if there is one, and only then says that it is ready."""
        self.rejoin()
        self._heartbeat.set(state=m.ServingState.READY)
        log.info("ready infer_p50_ms=%.1f", self._heartbeat.health.infer_p50_ns / 1e6)

    def step(self) -> bool:
        self._heartbeat.beat()
        worked = self._membership.step()
        for observation in self._observations.drain():
            if is_of_episode(self._link, observation.header):
                self._see(observation)
        for subgoal in self._subgoals.drain() if self._subgoals is not None else ():
            if is_of_episode(self._link, subgoal.header):
                self._node.on_subgoal(subgoal)
        for invocation in self._invocations.drain():
            if invocation.header.episode != self._link.episode:
                worked |= self.rejoin()
            if is_of_episode(self._link, invocation.header):
                self._node.on_invocation(invocation)
        for invocation in self._node.missed():
            text = f"invocation {invocation.invocation}: tick {invocation.tick} never came"
            self._tell(m.Severity.ERROR, "observation_missed", text)
        try:
            work = self._node.next_work()
        except MalformedMessage as error:
            self._link.drop("invocation", "wrong_request", str(error))
            return True
        if work is not None:
            self._invoke(work)
        return worked or work is not None

    def _see(self, observation: m.Observation) -> None:
        try:
            self._node.on_observation(observation)
        except MalformedMessage as error:
            self._link.drop(f"{observation.header.proc}#{observation.header.boot_id}", "wrong_shape", str(error))

    def rejoin(self) -> bool:
        """After a restart: asks which episode runs. There is nothing to rebuild."""
        if self._membership.rejoin() is None:
            return False
        self._membership.announce()
        return True

    def _invoke(self, work: Work) -> None:
        self._phase("invoke")
        self._heartbeat.set(is_inferring=True)
        start_ns = time.monotonic_ns()
        try:
            rows_NA = self._engine.invoke(work.request, self._heartbeat.beat)
        except ValueError as error:
            # No chunk: the clock plays what it has, then holds.
            self._tell(m.Severity.ERROR, "invocation_refused", f"invocation {work.invocation.invocation}: {error}")
            return
        finally:
            self._phase("idle")
            self._heartbeat.set(is_inferring=False)
        ready_ns = time.monotonic_ns()
        chunk = self._node.answer(work, rows_NA, infer_ns=ready_ns - start_ns)
        try:
            self._link.publish(topics.CHUNK, chunk, at_ns=ready_ns, clock_id=host_clock_id())
        except MalformedMessage as error:
            self._tell(m.Severity.ERROR, "chunk_refused", f"invocation {work.invocation.invocation}: {error}")
        self._heartbeat.set(
            next_index=work.invocation.invocation + 1, num_answered=self._heartbeat.health.num_answered + 1
        )

    def _open(self, request: m.OpenRequest) -> m.Contract:
        spec = self._engine.spec
        check_robot(request.info.robot, spec)
        if spec.reads_subgoal and not self._is_told:
            raise ValueError(
                "this checkpoint reads PONDER's subgoals in place of cognition, and no message of the protocol brings "
                "them to POUNCE; serve one that reads cognition, or evaluate with pp-eval --subgoal-text"
            )
        if self._is_told and not spec.reads_subgoal:
            raise ValueError(
                "this checkpoint reads cognition and no subgoals: it was not trained with reads_subgoal; leave "
                "--subgoal-text out"
            )
        self._check_committed(request.info.schedule)
        self._node.open(request.info)
        return m.Contract(
            proc="pounce",
            num_carriers=spec.num_carriers,
            hidden_size=spec.cognition_size,
            horizon=spec.horizon,
            action_dim=spec.action_dim,
            preferred_codec=images.wire_codec(self._link.bus.is_local),
            infer_p50_ns=self._heartbeat.health.infer_p50_ns,
            infer_p99_ns=self._heartbeat.health.infer_p99_ns,
            model_hash=spec.model_hash,
            is_fake=spec.is_random or spec.has_fresh_prefix,
            version=self._version,
        )

    def _check_committed(self, schedule: m.Schedule) -> None:
        """Raises ValueError if more ticks pass during an invocation than the network learned to be given rows for."""
        spec = self._engine.spec
        if spec.continuity != "trained":
            return
        ticks = delay_ticks(schedule, self._heartbeat.health.infer_p99_ns)
        if ticks > spec.max_committed_rows:
            raise ValueError(
                f"an invocation takes {ticks} ticks here, and this checkpoint learned to continue at most "
                f"{spec.max_committed_rows} rows; use --continuity rtc, or train with --max-committed-rows {ticks}"
            )

    def _close(self) -> None:
        self._node.open(None)

    def _phase(self, state: str) -> None:
        at_ns = time.monotonic_ns()
        self._link.publish(topics.PHASE, m.Phase(state=state), at_ns=at_ns, clock_id=host_clock_id())

    def _tell(self, severity: m.Severity, name: str, text: str) -> None:
        log.log(logging.WARNING if severity > m.Severity.INFO else logging.INFO, "event name=%s %s", name, text)
        event = m.Event(severity=severity, name=name, text=text)
        self._link.publish(topics.EVENT, event, at_ns=time.monotonic_ns(), clock_id=host_clock_id())
