"""The shell of ``pounce-serve``: drains the bus, runs the engine, publishes chunks."""

from __future__ import annotations

import time
from dataclasses import replace

from clock.channels import MODULATION, PREFIX, PROMPT
from clock.feasibility import delay_ticks
from dual_system.models.ponder.demo_sampling import DemoSampling
from model_server.shell import KEEP_OBSERVATIONS, ModelShell
from pounce_server.contract import Episodic, PounceEngine, check_robot
from pounce_server.node import PounceNode, Work
from protocol import codec, images, topics
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import EpisodeRefused, MalformedMessage
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id


class PounceServer(ModelShell):
    """POUNCE on a bus."""

    def __init__(self, link: Link, engine: PounceEngine, heartbeat: Heartbeat, version: str) -> None:
        reach_ticks = 0 if engine.spec.window is None else engine.spec.window.reach_ticks
        if engine.spec.past is not None:  # no tick of its grid may be pushed out while a chunk is computed
            reach_ticks = max(reach_ticks, 2 * engine.spec.horizon)
        super().__init__(link, engine, heartbeat, version, keep_observations=KEEP_OBSERVATIONS + reach_ticks)
        self._engine = engine
        self._node = PounceNode(engine.spec)
        self._invocations = link.subscribe(topics.INVOCATION)
        self._last: m.ActionChunk | None = None

    @property
    def num_superseded(self) -> int:
        return self._node.num_superseded

    def _weights_note(self) -> str:
        spec = self._engine.spec
        if spec.weights == "float":
            return ""
        return f"{spec.weights} weights: mean error of the normalised actions {spec.action_error:.1e}"

    def step(self) -> bool:
        worked, work = self._listen()
        if work is not None:
            self._invoke(work)
        return worked or work is not None or self.resume()

    def _listen(self) -> tuple[bool, Work | None]:
        """Reads all pending messages; returns whether there was a call or a bad request, and the work."""
        self._heartbeat.beat()
        worked = self._take_calls()
        self._take_observations()
        for invocation in self._invocations.drain():
            if invocation.header.episode != self._link.episode:
                worked |= self.rejoin()
            if self._link.is_from(invocation.header, "clock"):
                self._link.survive("invocation", self._node.on_invocation, invocation)
        for invocation in self._node.missed():
            text = f"invocation {invocation.invocation}: tick {invocation.tick} never came"
            self._tell(m.Severity.ERROR, "observation_missed", text)
        try:
            work = self._node.next_work()
        except MalformedMessage as error:
            self._link.drop("invocation", DropReason.WRONG_REQUEST, str(error))
            return True, None
        if work is not None and work.num_missing:
            text = f"invocation {work.invocation.invocation}: {work.num_missing} pictures of the past never came"
            self._tell(m.Severity.WARNING, "past_missing", text)
        return worked, work

    def _on_observation(self, observation: m.Observation) -> None:
        self._node.on_observation(observation)

    def rejoin(self) -> bool:
        """After a restart: asks for the running episode, and for the invocation that its predecessor did not answer."""
        rejoined = self._membership.rejoin()
        if rejoined is None:
            return False
        self._take_newest(rejoined)
        if rejoined.owed_invocation:
            self._node.on_invocation(codec.decode(m.Invocation, rejoined.owed_invocation))
        self._membership.announce()
        return True

    def resume(self) -> bool:
        """Takes the invocation that the clock waits for although it did not arrive, or sends its chunk again."""
        owed = None if self._is_shadow else self._membership.owed()
        if owed is None or not owed.owed_invocation:
            return False
        invocation = codec.decode(m.Invocation, owed.owed_invocation)
        if self._last is not None and self._last.invocation == invocation.invocation:
            self._link.publish(topics.CHUNK, self._last, at_ns=time.monotonic_ns(), clock_id=host_clock_id())
        else:
            self._take_newest(owed)
            self._node.on_invocation(invocation)
        return True

    def _invoke(self, work: Work) -> None:
        with self._inferring("invoke") as start_ns:
            try:
                rows_NA = self._engine.invoke(work.request, self._heartbeat.beat)
            except ValueError as error:
                self._refuse(work, error)
                return
        self._answer(work, rows_NA, start_ns)

    def _refuse(self, work: Work, error: ValueError) -> None:
        """Reports an invocation that the engine refused; in lockstep it is asked for again.

        Without a chunk the clock plays the rows it has, then holds.
        """
        self._node.on_refusal(work.invocation)
        self._tell(m.Severity.ERROR, "invocation_refused", f"invocation {work.invocation.invocation}: {error}")

    def _answer(self, work: Work, rows_NA: m.Floats, start_ns: int) -> None:
        ready_ns = time.monotonic_ns()
        chunk = self._node.answer(work, rows_NA, infer_ns=ready_ns - start_ns)
        try:
            topic = topics.SHADOW_CHUNK if self._is_shadow else topics.CHUNK
            self._last = self._link.publish(topic, chunk, at_ns=ready_ns, clock_id=host_clock_id())
        except MalformedMessage as error:
            self._tell(m.Severity.ERROR, "chunk_refused", f"invocation {work.invocation.invocation}: {error}")
        self._answered(work.invocation.invocation + 1)

    def _contract(self) -> m.Contract:
        spec = self._engine.spec
        return m.Contract(
            proc="pounce",
            num_carriers=spec.num_carriers,
            hidden_size=spec.cognition_size,
            horizon=spec.horizon,
            action_dim=spec.action_dim,
            preferred_codec=images.wire_codec(self._link.bus.is_local),
            infer_p50_ns=self._heartbeat.health.infer_p50_ns,
            infer_p99_ns=self._infer_p99_ns(),
            model_hash=spec.model_hash,
            is_fake=spec.is_fake,
            version=self._version,
            channels=self._channels(),
            control_hz=spec.control_hz,
            window=self._window(),
            demonstrations=None if spec.past is None else _as_message(spec.past.demonstrations),
        )

    def _window(self) -> m.ObservationWindow | None:
        spec = self._engine.spec
        if spec.past is None:
            return spec.window
        return replace(spec.window or m.ObservationWindow(), stride_ticks=spec.past.stride_ticks)

    def _channels(self) -> tuple[m.ChannelSpec, ...]:
        spec = self._engine.spec
        own = [MODULATION] if spec.past is not None else []
        return (*([PREFIX] if spec.num_carriers else []), *([PROMPT] if spec.reads_subgoal else []), *own)

    def _infer_p99_ns(self) -> int:
        return self._heartbeat.health.infer_p99_ns

    def _open(self, request: m.OpenRequest) -> m.Contract:
        spec = self._engine.spec
        check_robot(request.info.robot, spec)
        self._check_committed(request.info.schedule)
        if isinstance(self._engine, Episodic):
            self._engine.begin(request.info)
        self._node.open(request.info, request.demo)
        return self._contract()

    def _check_committed(self, schedule: m.Schedule) -> None:
        """Raises EpisodeRefused if an invocation takes more ticks than the network's committed rows in training."""
        spec = self._engine.spec
        if spec.continuity != "trained":
            return
        ticks = delay_ticks(schedule, self._infer_p99_ns())
        if ticks > spec.max_committed_rows:
            raise EpisodeRefused(
                m.Refusal.SCHEDULE,
                f"an invocation takes {ticks} ticks here, and this checkpoint learned to continue at most "
                f"{spec.max_committed_rows} rows; use --continuity rtc, or train with --max-committed-rows {ticks}",
            )

    def _close(self) -> None:
        self._node.open(None)
        self._last = None


def _as_message(sampling: DemoSampling) -> m.DemoSampling:
    return m.DemoSampling(hz=sampling.hz, to_its_end=sampling.to_its_end)
