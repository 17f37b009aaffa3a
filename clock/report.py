"""Statistics of an episode: counts, delays, ages, and one hash over all commands.

Pure functions of the log's messages; the client puts them into its results, ``pp-check`` prints them.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from clock.limits import Hit
from clock.timebase import NS_PER_MS
from protocol.messages import Invocation, Level, Stamp, StampKind, Tick

_HEAD = struct.Struct("<qI")  # tick, number of values
_TAIL = struct.Struct("<qq")  # cognition reference or -1, age_ns

PLAYED = (Level.PLAY, Level.STALE)

CLOCK_LOST_EVENT = "clock_lost"
"""Event of a robot side that ended the episode because no command came for too long."""
ADMITTED_EVENT = "admitted"
LEVEL_EVENT = "level"
"""Event of the clock service whose ladder is on another rung."""


def stream_sha256(ticks: Iterable[Tick]) -> str:
    """One hash over all commands and the cognition behind each: equal hashes mean equal episodes.

    The hashed bytes, little-endian, tick after tick without padding::

        int64    tick
        uint32   number of values in the action (0 for a skipped tick)
        float32  each value, as commanded
        int64    query of the cognition behind the row; -1 for none
        int64    age_ns

    Instants of the clock are not hashed, because in real time they differ from run to run.
    """
    digest = hashlib.sha256()
    for tick in ticks:
        digest.update(_HEAD.pack(tick.tick, len(tick.action)))
        digest.update(tick.action.astype("<f4").tobytes())
        digest.update(_TAIL.pack(-1 if tick.ref_query is None else tick.ref_query, tick.age_ns))
    return digest.hexdigest()


def statistics(ticks: Sequence[Tick], stamps: Sequence[Stamp], invocations: Sequence[Invocation]) -> dict[str, float]:
    """Flat statistics of one episode, for ``EpisodeResult.statistics``.

    Percentiles are observed values (nearest rank). A quantity without observations is absent rather than zero.
    """
    commanded = [t for t in ticks if t.level != Level.SKIPPED]
    played = [t for t in commanded if t.level in PLAYED]
    found: dict[str, float] = {"num_ticks": len(ticks)}
    found |= {f"{level.name.lower()}_ticks": sum(t.level == level for t in ticks) for level in Level if level}
    found["starved_ticks"] = num_starved(ticks)
    found["joint_clamps"] = sum(bool(t.limits_hit & Hit.JOINT) for t in commanded)
    found["step_clamps"] = sum(bool(t.limits_hit & Hit.STEP) for t in commanded)
    found["non_finite_rows"] = sum(bool(t.limits_hit & Hit.NON_FINITE) for t in commanded)
    found |= _spread("late_ms", [t.late_ns / NS_PER_MS for t in commanded])
    found |= _spread("age_ms", [t.age_ns / NS_PER_MS for t in played if t.ref_query is not None])
    found |= _spread("seam_jump_rad", [t.seam_jump for t in _after_switches(played)])
    found["num_invocations"] = len(invocations)
    found["null_invocations"] = sum(i.ref_query is None for i in invocations)
    found |= _spread("query_delay_ms", _delays_ms(stamps, StampKind.COGNITION))
    found |= _spread("invoke_delay_ms", _delays_ms(stamps, StampKind.CHUNK))
    return found


def num_starved(ticks: Iterable[Tick]) -> int:
    """Number of ticks for which no chunk had a usable row, after the first row played."""
    has_played = False
    starved = 0
    for tick in ticks:
        starved += has_played and tick.level != Level.SKIPPED and len(tick.raw_row) == 0
        has_played = has_played or tick.level in PLAYED
    return starved


def _after_switches(played: Sequence[Tick]) -> list[Tick]:
    """The first tick of every chunk but the first one."""
    return [now for before, now in pairwise(played) if now.invocation != before.invocation]


def _delays_ms(stamps: Iterable[Stamp], kind: StampKind) -> list[float]:
    return [(s.ready_ns - s.source_ns) / NS_PER_MS for s in stamps if s.kind == kind]


def _spread(name: str, values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {}
    p50, p95, p99 = np.percentile(values, (50, 95, 99), method="inverted_cdf")
    return {f"{name}_p50": float(p50), f"{name}_p95": float(p95), f"{name}_p99": float(p99), f"{name}_max": max(values)}
