"""Admission control: refuses, with a reason, a session that would break the latency budget. Pure arithmetic.

Sessions take turns (``batching``), so a query waits for at most one fire of every other session. One of these fires is
assumed slow (p99), the others median, and all of them in full contexts. Batching makes waits shorter, but the
guarantee does not rely on it.
"""

from dataclasses import dataclass, field

from ponder_server.contract import SessionError

MAX_LOAD = 0.8
"""Largest load from the queries of all sessions, as a fraction of time: the rest is for texts and variation."""


@dataclass(slots=True, kw_only=True)
class Admission:
    """Tracks admitted sessions; durations are measured on cognition-only fires in a full context."""

    fire_p50_ns: int
    fire_p99_ns: int
    latency_budget_ns: int
    """Limit of the time from a query to its cognition when all sessions query at once."""
    periods_ns: dict[str, int] = field(default_factory=dict)
    """Query period of every admitted session."""

    def admit(self, session: str, period_ns: int) -> None:
        """Admits a session, or raises SessionError with the expected latency or load and the way out."""
        others = {name: period for name, period in self.periods_ns.items() if name != session}
        worst_ns = len(others) * self.fire_p50_ns + self.fire_p99_ns
        if worst_ns > self.latency_budget_ns:
            raise SessionError(
                f"session {session!r} is refused: with {len(others)} others a query may take {_ms(worst_ns)} once "
                f"contexts are full, and the latency budget is {_ms(self.latency_budget_ns)}. Close a session, lower "
                "--max-context-tokens, or raise --latency-budget-ms."
            )
        load = sum(self.fire_p50_ns / period for period in (*others.values(), period_ns))
        if load > MAX_LOAD:
            raise SessionError(
                f"session {session!r} is refused: a query every {_ms(period_ns)} beside {len(others)} others is a load "
                f"of {load:.0%} at {_ms(self.fire_p50_ns)} each once contexts are full, and {MAX_LOAD:.0%} is the "
                "most. Close a session, lower --max-context-tokens, or query less often."
            )
        self.periods_ns[session] = period_ns

    def release(self, session: str) -> None:
        self.periods_ns.pop(session, None)


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / 1e6:.0f} ms"
