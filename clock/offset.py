"""The offset between two clocks, with a bound that holds for any network delay.

Four instants (NTP, RFC 5905 section 8): request sent t0 and reply received t3 on our clock, request received t1 and
reply sent t2 on theirs. The offset lies in [t1 - t0 - rtt, t1 - t0] if each way takes between zero and the whole round
trip, so the midpoint is wrong by at most half the round trip, asymmetric links included. The narrowest of several wins.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """theirs = ours + ``offset_ns``, with an error of at most ``bound_ns``."""

    offset_ns: int
    bound_ns: int

    def to_ours(self, theirs_ns: int) -> int:
        return theirs_ns - self.offset_ns


def from_exchange(t0_ns: int, t1_ns: int, t2_ns: int, t3_ns: int) -> Offset:
    """Offset from one exchange.

    Raises:
        ValueError: the instants of one clock run backwards.
    """
    round_trip_ns = (t3_ns - t0_ns) - (t2_ns - t1_ns)
    if t3_ns < t0_ns or t2_ns < t1_ns or round_trip_ns < 0:
        raise ValueError(f"impossible exchange: t0 {t0_ns}, t1 {t1_ns}, t2 {t2_ns}, t3 {t3_ns}")
    return Offset(offset_ns=((t1_ns - t0_ns) + (t2_ns - t3_ns)) // 2, bound_ns=-(-round_trip_ns // 2) + 1)


def narrowest(offsets: Iterable[Offset]) -> Offset:
    """The offset with the smallest bound. Clock drift in between is ignored: 100 ppm over 1 s is 0.1 ms."""
    return min(offsets, key=lambda o: o.bound_ns)
