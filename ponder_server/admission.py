"""Admission control: refuses, with a reason, a robot whose cognitions, or another's, would grow too old. Pure.

Sessions take turns (``batching``), so a query waits for at most one fire of every other session. One of these fires is
assumed slow (p99), the others median, and all of them in full contexts. Batching makes waits shorter, but the
guarantee does not rely on it.

A cognition is in use until the next one is there, a period and that query's latency after its own observation. What
is left of a robot's ``max_age_ns`` after its period is therefore the latency that it can bear. In lockstep the world
waits, and no age depends on latency: such a robot takes turns as every other, and bears anything.
"""

from dataclasses import dataclass, field

from ponder_server.contract import SessionError
from protocol.messages import Mode, Schedule

MAX_LOAD = 0.8
"""Largest load from the queries of all sessions, as a fraction of time: the rest is for texts and variation."""


@dataclass(slots=True, kw_only=True)
class Admission:
    """Tracks admitted robots; durations are measured on cognition-only fires in a full context."""

    fire_p50_ns: int
    fire_p99_ns: int
    admitted: dict[str, Schedule] = field(default_factory=dict)

    def admit(self, robot: str, schedule: Schedule) -> None:
        """Admits a robot, or raises SessionError with the expected age or load and the way out."""
        together = self.admitted | {robot: schedule}
        latency_ns = (len(together) - 1) * self.fire_p50_ns + self.fire_p99_ns
        in_time = {name: each for name, each in together.items() if each.mode == Mode.REALTIME}
        for name, each in in_time.items():
            if each.query_period_ns + latency_ns > each.max_age_ns:
                raise SessionError(
                    f"robot {robot!r} is refused: with {len(together) - 1} others a query may take {_ms(latency_ns)} "
                    f"once contexts are full, and the cognition of {name!r}, which asks every "
                    f"{_ms(each.query_period_ns)}, would be older than its --max-age-ms "
                    f"{each.max_age_ns // 1_000_000}. Close a session, lower --max-context-tokens, or raise "
                    "--max-age-ms."
                )
        load = sum(self.fire_p50_ns / each.query_period_ns for each in in_time.values())
        if load > MAX_LOAD:
            raise SessionError(
                f"robot {robot!r} is refused: a query every {_ms(schedule.query_period_ns)} beside "
                f"{len(together) - 1} others is a load of {load:.0%} at {_ms(self.fire_p50_ns)} each once contexts are "
                f"full, and {MAX_LOAD:.0%} is the most. Close a session, lower --max-context-tokens, or query less "
                "often."
            )
        self.admitted[robot] = schedule

    def release(self, robot: str) -> None:
        self.admitted.pop(robot, None)


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / 1e6:.0f} ms"
