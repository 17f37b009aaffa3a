"""The schedule of a training episode: when both models run, and each invocation's cognition.

Training samples its clocks (paper, A.1) and then pairs queries and invocations with the same functions as serving.
World and time are related as in serving with ``WaitKind.STAND_STILL``: the world stands until the first cognition is
ready, so tick k is due ``d_0 + k * 50 ms`` after the first observation. Otherwise a policy would be trained on a robot
that already moves when in serving it still stands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from clock.delays import in_order, log_normal_ns
from clock.playback import deadline_ns
from clock.reference import Ready, Reference, refer
from clock.schedules import CONTROL_HZ
from clock.timebase import NS_PER_MS, NS_PER_S
from protocol.messages import Delivery, DeliveryKind

EVERY: Final = Delivery(kind=DeliveryKind.EVERY)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogNormal:
    """A positive duration: arithmetic mean, and standard deviation in log space, clipped at three of them."""

    mean_ns: int
    sigma: float = 0.0

    def draw_ns(self, rng: np.random.Generator) -> int:
        return log_normal_ns(rng, self.mean_ns, self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """Query and invocation intervals in training, and PONDER's delay."""

    query: LogNormal
    invoke: LogNormal
    delay: LogNormal
    control_hz: int = CONTROL_HZ


ROBOMME: Final = Clocks(  # paper, A.1
    query=LogNormal(mean_ns=NS_PER_S, sigma=0.05),
    invoke=LogNormal(mean_ns=100 * NS_PER_MS, sigma=0.05),
    delay=LogNormal(mean_ns=300 * NS_PER_MS, sigma=0.3),
)
ROBOCASA_DC: Final = replace(  # paper, B.2; it gives no sigmas: those of RoboMME
    ROBOMME, query=LogNormal(mean_ns=4 * NS_PER_S, sigma=0.05), invoke=LogNormal(mean_ns=2 * NS_PER_S, sigma=0.05)
)
EVALUATION: Final = Clocks(  # paper, B.1: both at 1 Hz, 300 ms
    query=LogNormal(mean_ns=NS_PER_S),
    invoke=LogNormal(mean_ns=NS_PER_S),
    delay=LogNormal(mean_ns=300 * NS_PER_MS),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledQuery:
    """A query of PONDER on the observation of ``tick``."""

    tick: int
    stamp: Ready


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledInvocation:
    """An invocation of POUNCE on the observation of ``tick``, at which its row 0 is due, and on a cognition."""

    tick: int
    now_ns: int
    reference: Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledSchedule:
    """Queries and invocations, each in order of time."""

    queries: tuple[SampledQuery, ...]
    invocations: tuple[SampledInvocation, ...]


def sample_schedule(
    rng: np.random.Generator,
    clocks: Clocks,
    num_ticks: int,
    *,
    transition_ticks: frozenset[int] = frozenset(),
    delivery: Delivery = EVERY,
) -> SampledSchedule:
    """Draws the schedule of an episode of ``num_ticks`` observations.

    A query is a transition if it is the first, or the first at or after a tick of ``transition_ticks``.

    Raises:
        ValueError: the episode has no tick.
    """
    if num_ticks < 1:
        raise ValueError(f"an episode of {num_ticks} ticks has no schedule; it needs at least one")
    start_ns = clocks.delay.draw_ns(rng)
    queries = [SampledQuery(tick=0, stamp=Ready(query=0, source_ns=0, ready_ns=start_ns, is_transition=True))]
    for tick in _due_ticks(rng, clocks.query, 0, start_ns, num_ticks, clocks.control_hz):
        before = queries[-1]
        source_ns = deadline_ns(start_ns, tick, clocks.control_hz)
        ready_ns = in_order(source_ns + clocks.delay.draw_ns(rng), before.stamp.ready_ns)
        is_transition = any(before.tick < seen <= tick for seen in transition_ticks)
        stamp = Ready(query=len(queries), source_ns=source_ns, ready_ns=ready_ns, is_transition=is_transition)
        queries.append(SampledQuery(tick=tick, stamp=stamp))
    stamps = [query.stamp for query in queries]
    invocations = []
    for tick in (0, *_due_ticks(rng, clocks.invoke, start_ns, start_ns, num_ticks, clocks.control_hz)):
        now_ns = deadline_ns(start_ns, tick, clocks.control_hz)
        invocations.append(SampledInvocation(tick=tick, now_ns=now_ns, reference=refer(stamps, now_ns, delivery)))
    return SampledSchedule(queries=tuple(queries), invocations=tuple(invocations))


def _due_ticks(
    rng: np.random.Generator, interval: LogNormal, first_ns: int, start_ns: int, num_ticks: int, control_hz: int
) -> Iterator[int]:
    """Distinct ticks, after the one at ``first_ns``, at which a request with this interval is due."""
    due_ns, tick = first_ns + interval.draw_ns(rng), 0
    while True:
        tick = max(tick + 1, -(-(due_ns - start_ns) * control_hz // NS_PER_S))  # the first tick that is not before
        if tick >= num_ticks:
            return
        yield tick
        while due_ns <= deadline_ns(start_ns, tick, control_hz):
            due_ns += interval.draw_ns(rng)
