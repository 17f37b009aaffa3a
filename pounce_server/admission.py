"""Admission control: refuses, with a reason, a robot with which rows, its own or another's, would come too late. Pure.

Invocations that wait share a batch, and nobody has two in it. So an invocation waits at most for a batch of others that
has just begun and for those that come before it in turn, and is then answered with its own. A schedule bears d ticks of
that with d <= s <= H - d (`clock.feasibility`); one that starves in any case bears a period. In lockstep the world
waits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.errors import EpisodeRefused
from protocol.messages import Mode, Refusal, Schedule


@dataclass(slots=True, kw_only=True)
class Admission:
    """Tracks admitted robots. ``batch_ns`` is how long so many requests take together (p99), for some numbers."""

    batch_ns: Mapping[int, int]
    admitted: dict[str, Schedule] = field(default_factory=dict)

    @property
    def max_rows(self) -> int:
        return max(self.batch_ns)

    def worst_ns(self, num_robots: int) -> int:
        """Time from an invocation to its rows when all of ``num_robots`` are invoked at the worst instant."""
        rounds, rest = divmod(num_robots, self.max_rows)
        before_ns = self._batch_ns(min(num_robots - 1, self.max_rows)) if num_robots > 1 else 0
        return before_ns + rounds * self._batch_ns(self.max_rows) + (self._batch_ns(rest) if rest else 0)

    def worst_with(self, robot: str) -> int:
        """As ``worst_ns``, of the robots admitted and this one."""
        return self.worst_ns(len(self.admitted.keys() | {robot}))

    def admit(self, robot: str, schedule: Schedule) -> None:
        """Raises EpisodeRefused with the expected time and the way out. One robot alone is the clock's to judge."""
        together = self.admitted | {robot: schedule}
        worst_ns = self.worst_ns(len(together))
        for name, each in together.items():
            if len(together) > 1 and each.mode == Mode.REALTIME and worst_ns > (room_ns := room_of(each)):
                raise EpisodeRefused(
                    Refusal.BUSY,
                    f"robot {robot!r} is refused: with {len(together) - 1} others an invocation may take "
                    f"{worst_ns / 1e6:.0f} ms, and the schedule of {name!r} (s={each.invoke_period_ticks} "
                    f"H={each.horizon}) has room for {room_ns / 1e6:.0f} ms. Close a session, or change "
                    "--invoke-every-ticks.",
                )
        self.admitted[robot] = schedule

    def release(self, robot: str) -> None:
        self.admitted.pop(robot, None)

    def _batch_ns(self, num_requests: int) -> int:
        """The time of the next larger number that was measured."""
        return self.batch_ns[min(size for size in self.batch_ns if size >= num_requests)]


def room_of(schedule: Schedule) -> int:
    """How long an invocation may take [ns] without a tick that lacks a row."""
    every_ticks = schedule.invoke_period_ticks
    ticks = min(every_ticks, schedule.horizon - every_ticks)
    return (ticks if ticks > 0 else every_ticks) * 1_000_000_000 // schedule.control_hz
