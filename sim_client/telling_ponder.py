"""A PONDER that knows the task: it answers with the task's own subgoal, as late as any other.

This is the text channel with a perfect memory: the rows GroundSG + Oracle and SimpleSG + Oracle of the paper. In
RoboMME's own the policy reads the text of the very tick; here the text is that of the query's observation and comes
with PONDER's delay and age (`--delay-ms 0` comes near to theirs).
"""

from __future__ import annotations

import zlib

import numpy as np

from dual_system.models.ponder.coordinates import moved_places, normalised_text
from protocol import messages as m
from protocol import topics
from protocol.link import Link
from sim_client.ponder_double import Answer, PonderDouble

FAR_PX = 12.0
"""How far a displaced text's places are off, in pixels of a 256 px picture: about three centimetres of the table."""

_NO_VECTOR = np.zeros((0, 0), np.float32)


class TellingPonder(PonderDouble):
    """Answers with the task's subgoals of one kind, in the form that PONDER writes."""

    payloads = (m.PayloadKind.TEXT,)

    def __init__(self, link: Link, kind: m.SubgoalKind, off_px: float = 0.0) -> None:
        """``off_px``: the distance by which every place is off, in a direction that the tick and the place decide."""
        self._kind, self._off_px = kind, off_px
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
            text="" if newest is None else self._told_as(newest),
            text_age_ns=query.source_ns - self._since_ns,
        )

    def end(self) -> None:
        self._subgoals.drain()
        self._said.clear()
        self._told = None

    def _told_as(self, subgoal: m.Subgoal) -> str:
        text = normalised_text(subgoal.text)
        angle_rad = zlib.crc32(f"{subgoal.tick} {text}".encode()) / 2**32 * 2 * np.pi
        x_px, y_px = (round(self._off_px * float(part(angle_rad))) for part in (np.cos, np.sin))
        return moved_places(text, (x_px, y_px))
