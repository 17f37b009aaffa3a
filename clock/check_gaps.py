"""What a log lacks in the middle: messages that were sent and never reached the recorder.

Every sender numbers its messages of each topic. A link that is cut loses some of them, and a recorder that cannot keep
up drops some; then decisions after the gap cannot be derived, and those before it can.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

from clock.timebase import NS_PER_S
from protocol.mcap_log import EpisodeRecord
from protocol.messages import EPISODE_CLOCK, Header, StampKind

_OF_CLOCK = ("queries", "stamps", "invocations", "actions", "ticks", "events")
_ANSWERS = (("cognitions", "query", StampKind.COGNITION), ("chunks", "invocation", StampKind.CHUNK))


class Gap(NamedTuple):
    """Messages of one kind and sender that are missing after ``at_ns``, episode time."""

    at_ns: int
    proc: str
    kind: str
    num_missing: int


def before_gaps(record: EpisodeRecord) -> tuple[EpisodeRecord, str]:
    """The part of a log before anything is missing, and a sentence about what is; the log itself and "" if nothing is.

    It ends before the poll of the clock service that is the last one surely whole, and has no result.
    """
    gaps = [*_of_clock(record), *_last_stamps(record), *_of_answers(record)]
    if not gaps:
        return record, ""
    end_ns = min(gap.at_ns for gap in gaps)
    kept: dict[str, Any] = {
        name: [each for each in getattr(record, name) if _is_before(each, end_ns)] for name in _OF_CLOCK
    }
    missing = ", ".join(f"{gap.num_missing} of the {gap.kind} of {gap.proc}" for gap in gaps)
    why = (
        f"checked up to {end_ns / NS_PER_S:.2f} s, because of gaps after it: {missing} never reached the recorder "
        "(its link was cut, or it could not keep up)"
    )
    if record.recovered:
        why = f"{why}; {record.why}"
    shadows: dict[str, Any] = {
        "shadow_cognitions": _asked(record.shadow_cognitions, "query", kept["queries"]),
        "shadow_chunks": _asked(record.shadow_chunks, "invocation", kept["invocations"]),
    }
    return replace(record, result=None, recovered=True, why=why, **kept, **shadows), why


def _of_clock(record: EpisodeRecord) -> Iterator[Gap]:
    for kind in _OF_CLOCK:
        yield from _gaps(kind, [each for each in getattr(record, kind) if each.header.proc == "clock"])


def _last_stamps(record: EpisodeRecord) -> Iterator[Gap]:
    """Stamps that are missing at the end, after all others: what they admitted is played, or referred to."""
    used = {
        StampKind.CHUNK: {tick.invocation for tick in record.ticks},
        StampKind.COGNITION: {invocation.ref_query for invocation in record.invocations},
    }
    for kind, indices in used.items():
        newest = max((stamp.index for stamp in record.stamps if stamp.kind == kind), default=-1)
        if missing := {index for index in indices if index is not None and index > newest}:
            yield Gap(max((stamp.header.at_ns for stamp in record.stamps), default=0), "clock", "stamps", len(missing))


def _of_answers(record: EpisodeRecord) -> Iterator[Gap]:
    """Answers that were stamped and are missing between others, or at the end; from where they are first used."""
    for kind, index, stamp_kind in _ANSWERS:
        messages = getattr(record, kind)
        known = {getattr(each, index) for each in messages}
        missing = [s for s in record.stamps if s.kind == stamp_kind and s.index not in known]
        if missing and (any(_gaps(kind, messages)) or missing[0].index > max(known, default=-1)):
            proc = "ponder" if stamp_kind == StampKind.COGNITION else "pounce"
            yield Gap(missing[0].header.at_ns, proc, kind, len({stamp.index for stamp in missing}))


def _gaps(kind: str, messages: Sequence[Any]) -> Iterator[Gap]:
    by_boot: dict[int, list[Header]] = {}
    for each in messages:
        by_boot.setdefault(each.header.boot_id, []).append(each.header)
    for headers in by_boot.values():
        at_ns = 0
        for before, after in pairwise(headers):
            at_ns = before.at_ns if before.clock_id == EPISODE_CLOCK else at_ns
            if after.seq > before.seq + 1:
                yield Gap(at_ns, before.proc, kind, after.seq - before.seq - 1)


def _asked(answers: Sequence[Any], index: str, requests: Sequence[Any]) -> list[Any]:
    numbers = {getattr(each, index) for each in requests}
    return [each for each in answers if getattr(each, index) in numbers]


def _is_before(message: Any, end_ns: int) -> bool:
    return message.header.clock_id == EPISODE_CLOCK and message.header.at_ns < end_ns
