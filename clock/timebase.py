"""Clocks: a monotonic one in real time, and a virtual one that moves only by ``advance_to``.

All instants are int nanoseconds. ``MonotonicClock`` counts from its creation; on one Linux host
``time.monotonic_ns`` is the same clock in every process, between hosts it is not (see ``offset``).
"""

from __future__ import annotations

import time
from typing import Protocol

NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000


class Clock(Protocol):
    def now_ns(self) -> int: ...


class MonotonicClock:
    """Real time since ``zero_ns`` of the host's monotonic clock (default: now)."""

    def __init__(self, zero_ns: int | None = None) -> None:
        self.zero_ns = time.monotonic_ns() if zero_ns is None else zero_ns

    def now_ns(self) -> int:
        return time.monotonic_ns() - self.zero_ns


class VirtualClock:
    """Time that moves only by ``advance_to``, never backwards."""

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        return self._now_ns

    def advance_to(self, instant_ns: int) -> None:
        """Moves to ``instant_ns``.

        Raises:
            ValueError: that would be backwards.
        """
        if instant_ns < self._now_ns:
            raise ValueError(f"a clock does not run backwards: now {self._now_ns} ns, asked for {instant_ns} ns")
        self._now_ns = instant_ns
