"""For how long a robot's process has listened and heard no command."""

from __future__ import annotations

from dataclasses import dataclass

from clock.timebase import NS_PER_MS

CLOCK_SILENCE_NS = 500 * NS_PER_MS
"""Real time: commands that stay away this long mean that the clock service is gone. The servos hold meanwhile."""
STALL_NS = 200 * NS_PER_MS
"""Real time: a turn of 20 ms that takes this long means that this process stood still, and heard nobody meanwhile."""


@dataclass(slots=True)
class Silence:
    """Instants are monotonic.

    A process that stood still has not listened: what was sent meanwhile may not have been read yet, so such a time is
    nobody's silence but its own.
    """

    looked_ns: int
    stall_ns: int = STALL_NS
    """Time between two looks from which on the process stood still."""
    total_ns: int = 0

    def heard(self, now_ns: int) -> None:
        """A command came, and was obeyed by now."""
        self.looked_ns, self.total_ns = now_ns, 0

    def look(self, now_ns: int) -> int:
        """Counts the time since the last look; returns it if the process stood still, else 0."""
        away_ns, self.looked_ns = now_ns - self.looked_ns, now_ns
        if away_ns >= self.stall_ns:
            return away_ns
        self.total_ns += away_ns
        return 0
