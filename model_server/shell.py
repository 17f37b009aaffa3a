"""The shell that PONDER's and POUNCE's servers share: membership in an episode, warm-up, readiness, phases, events."""

from __future__ import annotations

import contextlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Protocol

from model_server.membership import Membership
from protocol import codec, topics
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import MalformedMessage
from protocol.heartbeat import Heartbeat
from protocol.link import Link, source_of
from protocol.process import IDLE_WAIT_NS, host_clock_id

log = logging.getLogger(__name__)

KEEP_OBSERVATIONS = 8


class Spec(Protocol):
    """The part of every engine's spec that the shell uses."""

    @property
    def model_hash(self) -> str: ...
    @property
    def is_fake(self) -> bool:
        """True if untrained weights decide the answers."""
        ...

    @property
    def kernels(self) -> str:
        """Which kernels of ours it runs and why not others, once it is warm; "" if it tried none."""
        ...


class Engine(Protocol):
    """The part of an engine that the shell uses."""

    @property
    def spec(self) -> Spec: ...
    def warm_up(self) -> list[int]:
        """Durations in ns of at least 20 answers, without the first few."""
        ...


class ModelShell(ABC):
    """One model server on a bus. ``step`` does one piece of work and returns whether there was any."""

    def __init__(
        self,
        link: Link,
        engine: Engine,
        heartbeat: Heartbeat,
        version: str,
        *,
        keep_observations: int = KEEP_OBSERVATIONS,
    ) -> None:
        """``keep_observations``: how many wait while an answer is computed; of more, the oldest are lost."""
        self.link = self._link = link
        self.heartbeat = self._heartbeat = heartbeat
        self._version = version
        self._warmed_engine = engine
        self._membership = Membership(link, heartbeat, self._contract, self._open, self._close)
        self._observations = link.subscribe(topics.OBSERVATION, keep=keep_observations)
        self._is_shadow = link.proc in topics.SHADOW_OF
        self._infos = link.subscribe(topics.INFO) if self._is_shadow else None

    @property
    def shells(self) -> tuple[ModelShell, ...]:
        return (self,)

    @property
    @abstractmethod
    def num_superseded(self) -> int:
        """Number of requests that a newer one replaced before the model read them."""

    def drain(self) -> bool:
        """Opens no more episodes from now on; returns whether none runs. Nobody misses a shadow."""
        return self._membership.drain() or self._is_shadow

    @abstractmethod
    def step(self) -> bool: ...

    @abstractmethod
    def rejoin(self) -> bool:
        """After a restart: asks for the running episode and joins it; returns whether there was one."""

    @abstractmethod
    def _on_observation(self, observation: m.Observation) -> None:
        """Takes an observation. Raises MalformedMessage if the engine cannot read it."""

    @abstractmethod
    def _contract(self) -> m.Contract:
        """This server's contract for any episode."""

    @abstractmethod
    def _open(self, request: m.OpenRequest) -> m.Contract:
        """Starts the episode in the engine. Raises ValueError to refuse, or EpisodeRefused with a refusal code."""

    @abstractmethod
    def _close(self) -> None:
        """Ends the episode."""

    def _weights_note(self) -> str:
        """The error of narrow weights, for heartbeats and logs; "" for float weights."""
        return ""

    def warm_up(self) -> None:
        """Measures the engine before it serves, without the first answers of the process, which are slower."""
        self._heartbeat.set(state=m.ServingState.WARMING)
        self.warmed(self._warmed_engine.warm_up())

    def warmed(self, durations_ns: list[int]) -> None:
        """Announces the engine and how long its answers took in the warm-up."""
        spec = self._warmed_engine.spec
        self._heartbeat.set(
            infer_p50_ns=percentile_ns(durations_ns, 50),
            infer_p99_ns=percentile_ns(durations_ns, 99),
            model_hash=spec.model_hash,
            is_fake=spec.is_fake,
            progress=1.0,
        )
        if note := "; ".join(filter(None, (self._weights_note(), spec.kernels))):
            self._heartbeat.set(detail=note)
            log.info("%s", note)

    def ready(self) -> None:
        """Joins a running episode, if there is one, and only then reports readiness."""
        while not self.rejoin() and self._membership.is_asking:
            self._heartbeat.beat()
            self._link.bus.wait(IDLE_WAIT_NS)
        self._heartbeat.set(state=m.ServingState.READY)
        log.info("ready infer_p50_ms=%.1f", self._heartbeat.health.infer_p50_ns / 1e6)

    def _take_calls(self) -> bool:
        """Answers the clock service, and asks it in case an episode began or goes on without this server."""
        worked = self._membership.step()
        for info in self._infos.drain() if self._infos is not None else ():  # nobody opens a shadow's episode
            if info.header.proc == "clock" and info.header.episode != self._link.episode:
                self._membership.leave()
        if self._membership.may_have_missed_one and self._heartbeat.health.state == m.ServingState.READY:
            worked |= self.rejoin()
        return worked

    def _take_observations(self) -> None:
        for observation in self._observations.drain():
            if self._link.is_from(observation.header, "sim"):
                self._take(observation)

    def _take_newest(self, rejoined: m.ActiveReply) -> None:
        """Takes the observations that came before this server did: the next request may name the newest."""
        for payload in filter(None, (*rejoined.recent, rejoined.observation)):
            self._take(codec.decode(m.Observation, payload))

    def _take(self, observation: m.Observation) -> None:
        source = source_of(observation.header)
        try:
            self._link.survive(source, self._on_observation, observation)
        except MalformedMessage as error:
            self._link.drop(source, DropReason.WRONG_SHAPE, str(error))

    def _begin_inference(self, phase: str) -> int:
        """Reports that an answer is being computed; returns the start (monotonic ns)."""
        self._phase(phase)
        self._heartbeat.set(is_inferring=True)
        return time.monotonic_ns()

    def _end_inference(self) -> None:
        self._phase("idle")
        self._heartbeat.set(is_inferring=False)

    @contextlib.contextmanager
    def _inferring(self, phase: str) -> Iterator[int]:
        try:
            yield self._begin_inference(phase)
        finally:
            self._end_inference()

    def _answered(self, next_index: int) -> None:
        self._heartbeat.set(next_index=next_index, num_answered=self._heartbeat.health.num_answered + 1)

    def _phase(self, state: str) -> None:
        at_ns = time.monotonic_ns()
        self._link.publish(topics.PHASE, m.Phase(state=state), at_ns=at_ns, clock_id=host_clock_id())

    def _tell(self, severity: m.Severity, name: str, text: str) -> None:
        log.log(logging.WARNING if severity > m.Severity.INFO else logging.INFO, "event name=%s %s", name, text)
        event = m.Event(severity=severity, name=name, text=text)
        self._link.publish(topics.EVENT, event, at_ns=time.monotonic_ns(), clock_id=host_clock_id())


def percentile_ns(durations_ns: list[int], percent: float) -> int:
    """Nearest-rank percentile; 0 for an empty list."""
    if not durations_ns:
        return 0
    rank = max(1, -(-len(durations_ns) * percent // 100))
    return sorted(durations_ns)[int(rank) - 1]
