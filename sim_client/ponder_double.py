"""A PONDER on a bus without a model: the base class of those that replace it in an experiment."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

from model_server.membership import Membership
from protocol import messages as m
from protocol import topics
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.version import version


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """A cognition in place of PONDER's."""

    vector: m.Floats
    """(K, H)."""
    is_transition: bool
    norm: float
    text: str = ""
    """The subgoal in force."""
    text_age_ns: int = 0
    """Age of that subgoal at the query's observation."""
    gate_score: float | None = None


class PonderDouble(ABC):
    """Joins episodes and answers queries as ``ponder-serve`` does; subclasses decide with what."""

    payloads: tuple[m.PayloadKind, ...] = (m.PayloadKind.VECTORS, m.PayloadKind.TEXT)
    """What it gives."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._heartbeat = Heartbeat(link, version(), host_clock_id())
        self._membership = Membership(link, self._heartbeat, self._contract, self._open, self.end)
        self._queries = link.subscribe(topics.QUERY)
        self._heartbeat.set(state=m.ServingState.READY, progress=1.0)

    @property
    @abstractmethod
    def model_hash(self) -> str:
        """Identifies the source of the vectors in every log."""

    @property
    @abstractmethod
    def is_fake(self) -> bool:
        """Whether the vectors come from no trained model."""

    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Returns (K, H) of the episode to be opened. Raises ValueError if there is nothing to answer with."""

    @abstractmethod
    def answer(self, query: m.Query) -> Answer:
        """Returns the answer to a query."""

    @abstractmethod
    def end(self) -> None:
        """Called when an episode is over, or about to begin."""

    def step(self) -> bool:
        """Answers pending queries; returns whether there was anything to do."""
        self._heartbeat.beat()
        worked = self._membership.step()
        for query in self._queries.drain():
            if self.link.is_from(query.header, "clock"):
                self._publish(query, self.answer(query))
                worked = True
        return worked

    def _publish(self, query: m.Query, answer: Answer) -> None:
        now_ns = time.monotonic_ns()
        cognition = m.Cognition(
            query=query.query,
            tick=query.tick,
            source_ns=query.source_ns,
            ready_ns=now_ns,
            vector=answer.vector,
            is_transition=answer.is_transition,
            norm=answer.norm,
            model_hash=self.model_hash,
            is_fake=self.is_fake,
            text=answer.text,
            text_source_ns=query.source_ns - answer.text_age_ns if answer.text else 0,
            gate_score=answer.gate_score,
        )
        self.link.publish(topics.COGNITION, cognition, at_ns=now_ns, clock_id=host_clock_id())

    def _open(self, request: m.OpenRequest) -> m.Contract:
        return self._contract()

    def _contract(self) -> m.Contract:
        num_carriers, hidden_size = self.shape()
        return m.Contract(
            proc="ponder",
            num_carriers=num_carriers,
            hidden_size=hidden_size,
            model_hash=self.model_hash,
            is_fake=self.is_fake,
            version=version(),
            channels=tuple(m.ChannelSpec(payload=kind) for kind in self.payloads),
        )
