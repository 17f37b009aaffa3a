"""Which session may join: refused with a reason before it costs anybody else their latency. Pure arithmetic.

Sessions take turns (``batching``), so the worst a query waits is one fire of every other session. One of these may be a
slow one, not all of them: the others count with their median. Contexts grow, and a fire with them: every session counts
as if its context were full. Batching makes it better than that; the promise does not count on it.
"""

from dataclasses import dataclass, field

from ponder_server.contract import SessionError

MAX_LOAD = 0.8
"""Share of the time that the queries of all sessions may take: the rest is for texts, and for luck."""


@dataclass(slots=True, kw_only=True)
class Admission:
    """Bookkeeping of admitted sessions, by what a cognition-only fire in a full context was measured to take."""

    fire_p50_ns: int
    fire_p99_ns: int
    latency_budget_ns: int
    """From a query to its cognition, when every session asks at once."""
    periods_ns: dict[str, int] = field(default_factory=dict)
    """Admitted session -> the time between its queries."""

    def admit(self, session: str, period_ns: int) -> None:
        """Takes a session in, or raises SessionError saying what it would cost and what to change."""
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
