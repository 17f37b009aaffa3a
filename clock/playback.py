"""Playback of chunks at a fixed rate: the row due at a tick, and how chunks are joined.

The row is a function of the tick and of the chunk's ``t_row0``, never of an estimated latency: rows that are past when
a chunk arrives are never played. Deadlines are computed from the start, so errors do not accumulate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clock.dimensions import absolute
from clock.timebase import NS_PER_S
from protocol.messages import ActionChunk, Floats, Robot, Seam, SeamKind


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chunk:
    """A POUNCE answer, as far as playback needs it. ``rows_NA``: (horizon, action_dim) float32, as they are played."""

    invocation: int
    t_row0: int
    rows_NA: Floats
    ref_query: int | None
    age_ns: int
    first_tick: int | None = None  # first tick decided after its arrival; earlier rows were past
    given_NA: Floats | None = None  # as POUNCE gave them, if that is something else

    @classmethod
    def of(cls, answer: ActionChunk, robot: Robot, first_tick: int | None = None) -> Chunk:
        """The chunk of an answer: increments are summed up from the state of its observation."""
        rows_NA = absolute(answer.rows_NA, answer.reference_state, robot)
        return cls(
            invocation=answer.invocation,
            t_row0=answer.t_row0,
            rows_NA=rows_NA,
            ref_query=answer.ref_query,
            age_ns=answer.age_ns,
            first_tick=first_tick,
            given_NA=None if rows_NA is answer.rows_NA else answer.rows_NA,
        )

    def given_from(self, tick: int) -> Floats:
        """(n, action_dim), POUNCE's own rows from ``tick`` on."""
        return (self.rows_NA if self.given_NA is None else self.given_NA)[tick - self.t_row0 :]


def deadline_ns(start_ns: int, tick: int, rate_hz: int) -> int:
    """Deadline of a tick, rounded up to a whole nanosecond."""
    return start_ns - (-tick * NS_PER_S // rate_hz)


def tick_at(start_ns: int, now_ns: int, rate_hz: int) -> int:
    """The newest tick whose deadline has passed; the inverse of ``deadline_ns``. Negative before the start."""
    return (now_ns - start_ns) * rate_hz // NS_PER_S


def row_of(chunk: Chunk, tick: int) -> int | None:
    """Index of the row due at ``tick``; None if the chunk does not reach it."""
    row = tick - chunk.t_row0
    return row if 0 <= row < len(chunk.rows_NA) else None


Join = Callable[[Sequence[Chunk], int], Floats]
"""A seam policy: (chunks with a row for the tick, oldest first, at least one; tick) -> row (action_dim,)."""


def switch(chunks: Sequence[Chunk], tick: int) -> Floats:
    """The newest chunk's row."""
    return _row(chunks[-1], tick)


def offset_fade(fade_ticks: int, is_gripper_A: NDArray[np.bool_]) -> Join:
    """Cancels the jump at the switch and fades the correction out linearly over ``fade_ticks``.

    The jump is the previous chunk's row minus the new chunk's at the first tick that the new one can play: a pure
    function of the chunks and of their arrivals, so it can be derived again from the log.
    """

    def join(chunks: Sequence[Chunk], tick: int) -> Floats:
        row = _row(chunks[-1], tick)
        if len(chunks) < 2:
            return row
        new, old = chunks[-1], chunks[-2]
        switched = new.t_row0 if new.first_tick is None else max(new.t_row0, new.first_tick)
        since = tick - switched
        weight = max(0.0, 1.0 - since / fade_ticks) if fade_ticks else 0.0
        if weight == 0.0 or row_of(old, switched) is None:
            return row
        jump = _row(old, switched) - _row(new, switched)
        jump[is_gripper_A] = 0.0  # a gripper is binary: do not blend it
        return (row + np.float32(weight) * jump).astype(np.float32)

    return join


def ensemble(decay: float, is_gripper_A: NDArray[np.bool_]) -> Join:
    """Exponential average over all chunks that cover the tick; the oldest weighs most for decay > 0 (ACT)."""

    def join(chunks: Sequence[Chunk], tick: int) -> Floats:
        weights = [math.exp(-decay * rank) for rank in range(len(chunks))]
        rows = np.stack([_row(c, tick) for c in chunks]).astype(np.float64)
        mean = np.average(rows, axis=0, weights=weights).astype(np.float32)
        mean[is_gripper_A] = _row(chunks[-1], tick)[is_gripper_A]  # an averaged gripper would be half open
        return mean

    return join


def seam_policy(seam: Seam, is_gripper_A: NDArray[np.bool_]) -> Join:
    if seam.kind == SeamKind.OFFSET_FADE:
        return offset_fade(seam.fade_ticks, is_gripper_A)
    if seam.kind == SeamKind.ENSEMBLE:
        return ensemble(seam.ensemble_decay, is_gripper_A)
    return switch


def covering(chunks: Sequence[Chunk], tick: int) -> list[Chunk]:
    """The chunks with a row for ``tick``, oldest first."""
    return sorted((c for c in chunks if row_of(c, tick) is not None), key=lambda c: c.invocation)


def _row(chunk: Chunk, tick: int) -> Floats:
    row = row_of(chunk, tick)
    if row is None:
        raise ValueError(f"chunk {chunk.invocation} has rows for ticks {chunk.t_row0}..; tick {tick} is not among them")
    values: Floats = chunk.rows_NA[row].astype(np.float32, copy=True)
    return values
