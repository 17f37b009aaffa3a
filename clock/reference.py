"""The cognition that a POUNCE invocation refers to: the paper's rule (section 3.3) and its interventions (5.2).

    ref(j) = max{ t : tau_t + d_t <= tau_j },   Delta(j) = tau_j - tau_ref(j);   nothing ready: null, Delta = 0

Training, serving and the offline checker call these same functions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from protocol.messages import Cognition, Delivery, DeliveryKind


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """The instants of one PONDER query's observation and of its answer's availability, in episode time."""

    query: int
    source_ns: int
    ready_ns: int
    is_transition: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """An invocation's query (None: the null cognition) and the age with which it is conditioned."""

    query: int | None
    age_ns: int


NULL = Reference(query=None, age_ns=0)


def latest_ready(stamps: Iterable[Ready], now_ns: int) -> Ready | None:
    """The newest query that is ready at ``now_ns``; None before the first. A slow query never hides a newer one."""
    return max((s for s in stamps if s.ready_ns <= now_ns), key=lambda s: s.query, default=None)


def age_ns(ref: Ready | None, now_ns: int) -> int:
    """Age since the observation, not since the answer was ready; the null cognition has age 0."""
    return 0 if ref is None else now_ns - ref.source_ns


def text_age_ns(cognition: Cognition, now_ns: int) -> int:
    """Age of a cognition's text since the observation it was written about; without a text 0."""
    return now_ns - cognition.text_source_ns if cognition.text else 0


def held_at_transition(stamps: Iterable[Ready], now_ns: int) -> Ready | None:
    """The newest ready query among the first one and those at transitions (paper, 5.2)."""
    stamps = list(stamps)
    first = min((s.query for s in stamps), default=None)
    return latest_ready((s for s in stamps if s.is_transition or s.query == first), now_ns)


def refer(stamps: Iterable[Ready], now_ns: int, delivery: Delivery) -> Reference:
    """Applies a delivery to the stamps: the reference of an invocation at ``now_ns``."""
    if delivery.kind == DeliveryKind.NULL:
        return NULL
    if delivery.kind == DeliveryKind.HELD_TRANSITION:
        ref = held_at_transition(stamps, now_ns)
    else:
        ref = latest_ready(stamps, now_ns)
    if ref is None:
        return NULL
    return Reference(query=ref.query, age_ns=delivery.reported_age_ns or age_ns(ref, now_ns))
