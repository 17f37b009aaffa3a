"""A PONDER that knows the task: it answers with the task's own subgoal, as late as any other.

This is the text channel with a perfect memory: the rows GroundSG + Oracle and SimpleSG + Oracle of the paper. In
RoboMME's own the policy reads the text of the very tick; here the text is that of the query's observation and comes
with PONDER's delay and age (`--delay-ms 0` comes near to theirs).
"""

from __future__ import annotations

import numpy as np

from dual_system.models.ponder.coordinates import normalised_text
from protocol import messages as m
from protocol import topics
from protocol.link import Link
from sim_client.ponder_double import Answer, PonderDouble

_NO_VECTOR = np.zeros((0, 0), np.float32)


class TellingPonder(PonderDouble):
    """Answers with the task's subgoals of one kind, in the form that PONDER writes."""

    payloads = (m.PayloadKind.TEXT,)

    def __init__(self, link: Link, kind: m.SubgoalKind) -> None:
        self._kind = kind
        self._said: list[m.Subgoal] = []
        self._subgoals = link.subscribe(topics.SUBGOAL)
        self._told: m.Subgoal | None = None
        self._since_ns = 0
        super().__init__(link)

    @property
    def model_hash(self) -> str:
        return f"task-{self._kind.name.lower().removeprefix('task_')}"

    @property
    def is_fake(self) -> bool:
        return False

    def shape(self) -> tuple[int, int]:
        return 0, 0

    def answer(self, query: m.Query) -> Answer:
        self._said += [each for each in self._subgoals.drain() if each.kind == self._kind]
        newest = next((each for each in reversed(self._said) if each.tick <= query.tick), None)
        is_new = newest is not None and newest is not self._told
        if is_new:
            self._told, self._since_ns = newest, query.source_ns
        return Answer(
            vector=_NO_VECTOR,
            is_transition=is_new,
            norm=0.0,
            text="" if newest is None else normalised_text(newest.text),
            text_age_ns=query.source_ns - self._since_ns,
        )

    def end(self) -> None:
        self._subgoals.drain()
        self._said.clear()
        self._told = None
