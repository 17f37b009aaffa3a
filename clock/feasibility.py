"""Checks, before the robot moves, that a schedule plays without gaps: d <= s <= H - d.

H is the number of rows per chunk, s the ticks between invocations, d the ticks from an invocation to its first playable
row. The paper's own setting (20 rows at 20 Hz, one invocation per second: s = H = 20) starves d ticks per chunk in real
time; in its lockstep evaluation d is 0 and no tick starves.
"""

from __future__ import annotations

from dataclasses import dataclass

from clock.timebase import NS_PER_MS, NS_PER_S
from protocol.messages import DelayKind, Mode, Schedule


@dataclass(frozen=True, slots=True, kw_only=True)
class Feasibility:
    """Result of the check; ``ways_out`` are complete sentences for the user."""

    horizon: int
    invoke_ticks: int
    delay_ticks: int
    ways_out: tuple[str, ...] = ()

    @property
    def starved_ticks(self) -> int:
        return max(0, self.invoke_ticks + self.delay_ticks - self.horizon)

    @property
    def is_feasible(self) -> bool:
        return self.delay_ticks <= self.invoke_ticks <= self.horizon - self.delay_ticks

    def sentence(self) -> str:
        d, s, h = self.delay_ticks, self.invoke_ticks, self.horizon
        verdict = "holds" if self.is_feasible else f"fails, {self.starved_ticks} starved tick(s) per chunk"
        rule = f"d <= s <= H - d with d={d} s={s} H={h}: {verdict}."
        return " ".join((rule, *self.ways_out))


def delay_ticks(schedule: Schedule, invoke_p99_ns: int) -> int:
    """Ticks from an invocation to its chunk's first playable row; a chunk between two ticks waits for the next one."""
    if schedule.invoke_delay.kind != DelayKind.MEASURED:
        invoke_p99_ns = schedule.invoke_delay.mean_ns
    elif schedule.mode == Mode.LOCKSTEP:
        return 0  # in lockstep the world waits
    return -(-invoke_p99_ns * schedule.control_hz // NS_PER_S)


def check_feasible(schedule: Schedule, invoke_p99_ns: int) -> Feasibility:
    """Checks a schedule. ``invoke_p99_ns`` is measured at the server's warm-up, with transport if known."""
    d, s, h = delay_ticks(schedule, invoke_p99_ns), schedule.invoke_period_ticks, schedule.horizon
    ways_out: list[str] = []
    if not d <= s <= h - d:
        if h - d >= d and h - d >= 1:
            best_ms = (h - d) * NS_PER_S / schedule.control_hz / NS_PER_MS
            ways_out.append(f"Invoke every {h - d} ticks or sooner (--invoke-every-ticks {h - d}, {best_ms:.0f} ms).")
        else:
            ways_out.append(
                f"A chunk of {h} rows cannot bridge {2 * d} ticks of delay: use a longer horizon or a faster model."
            )
        ways_out.append(
            "Or accept the gap: clock-serve --allow-starved (with --local the same option here) holds the last row "
            "there and counts it."
        )
    return Feasibility(horizon=h, invoke_ticks=s, delay_ticks=d, ways_out=tuple(ways_out))
