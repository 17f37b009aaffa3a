"""The difference between two clocks, with a bound that holds whatever the network does.

Four instants (NTP, RFC 5905 section 8): t0 asked and t3 answered on our clock, t1 received and t2 replied on theirs.
The offset lies in [t1 - t0 - rtt, t1 - t0] if the two ways take between nothing and the whole round trip, so the
midpoint is wrong by at most half the round trip, asymmetric links included. Narrowest of several wins.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """theirs = ours + ``offset_ns``, and the truth is within ``bound_ns`` of that."""

    offset_ns: int
    bound_ns: int

    def to_ours(self, theirs_ns: int) -> int:
        return theirs_ns - self.offset_ns


def from_exchange(t0_ns: int, t1_ns: int, t2_ns: int, t3_ns: int) -> Offset:
    """One exchange.

    Raises:
        ValueError: instants of one clock run backwards.
    """
    round_trip_ns = (t3_ns - t0_ns) - (t2_ns - t1_ns)
    if t3_ns < t0_ns or t2_ns < t1_ns or round_trip_ns < 0:
        raise ValueError(f"impossible exchange: t0 {t0_ns}, t1 {t1_ns}, t2 {t2_ns}, t3 {t3_ns}")
    return Offset(offset_ns=((t1_ns - t0_ns) + (t2_ns - t3_ns)) // 2, bound_ns=-(-round_trip_ns // 2) + 1)


def narrowest(offsets: Iterable[Offset]) -> Offset:
    """The one with the smallest bound. Drift over the seconds they span is ignored: 100 ppm over 1 s is 0.1 ms."""
    return min(offsets, key=lambda o: o.bound_ns)
