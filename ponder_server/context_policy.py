"""Policies for a full context: pure functions that choose which spans stay.

All but ``refuse`` make attention forget spans for good: their keys and values leave the cache, later tokens keep their
positions, and the recurrent layers keep their summary of them. No token is recomputed, so a full context costs one copy
and no pause. Training has no contexts with holes: these policies are for episodes that would otherwise end, and a
model should be trained, or at least tested, with the policy it is served with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from dual_system.models.ponder.context import SegmentKind
from ponder_server.contract import PolicyName


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive cached tokens of one kind."""

    kind: SegmentKind
    num_tokens: int


Policy: TypeAlias = Callable[[Sequence[Span], int], list[bool]]
"""(spans of the context, tokens to free) -> which spans stay. If it frees fewer tokens, the query is refused."""

_OF_A_QUERY = (SegmentKind.OBSERVATION, SegmentKind.TEXT, SegmentKind.CARRIERS)


def refuse(spans: Sequence[Span], num_excess: int) -> list[bool]:
    """Keeps everything: the query is refused, cognition ages, and the ladder acts."""
    return [True] * len(spans)


def pin_and_slide(spans: Sequence[Span], num_excess: int) -> list[bool]:
    """Keeps instruction and demonstration; forgets whole queries, oldest first, at least half of them."""
    return _forget_oldest(spans, num_excess, _OF_A_QUERY)


def carriers_only(spans: Sequence[Span], num_excess: int) -> list[bool]:
    """Forgets at least half of the observations, oldest first; keeps texts and carriers, which summarise them."""
    return _forget_oldest(spans, num_excess, (SegmentKind.OBSERVATION,))


POLICIES: dict[PolicyName, Policy] = {
    "refuse": refuse,
    "pin-and-slide": pin_and_slide,
    "carriers-only": carriers_only,
}


def _forget_oldest(spans: Sequence[Span], num_excess: int, kinds: Sequence[SegmentKind]) -> list[bool]:
    """Forgets half at a time, so that it happens seldom, and up to the end of a query, so that none is cut."""
    num_candidates = sum(span.num_tokens for span in spans if span.kind in kinds)
    num_to_go = max(num_excess, num_candidates // 2)
    stays: list[bool] = []
    for span in spans:
        starts_query = span.kind is SegmentKind.OBSERVATION
        if starts_query and num_to_go <= 0:
            kinds = ()
        stays.append(span.kind not in kinds)
        num_to_go -= 0 if stays[-1] else span.num_tokens
    return stays
