"""The open episode as the clock service keeps it: what may still come, and what a restarted server is told."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import accumulate

from clock.conductor import Conductor, Stage
from clock.policies import servers_of
from clock.timebase import NS_PER_S, MonotonicClock, VirtualClock
from protocol import messages as m

MAX_RECENT_BYTES = 32 << 20  # half of what a message may be


@dataclass(slots=True)
class Episode:
    """One episode, from its opening to its end."""

    request: m.OpenRequest
    conductor: Conductor
    clock: MonotonicClock | VirtualClock | None = None  # starts with the first observation: episode time 0
    journal: list[m.JournalEntry] = field(default_factory=list)
    journal_bytes: int = 0
    newest_payload: bytes = b""
    recent: deque[bytes] = field(default_factory=lambda: deque(maxlen=0))
    """Lockstep: the observations before the newest in POUNCE's window, for one that restarts."""
    remembered: deque[bytes] = field(default_factory=deque)
    """Lockstep: the newest that POUNCE's memory has pictures of, in order, for one that restarts."""
    remembered_bytes: int = 0
    invoked: m.Invocation | None = None
    """The newest invocation, for a POUNCE that restarts before it has answered."""
    phase: str = ""
    contracts: dict[str, m.Contract] = field(default_factory=dict)
    """Terms of both servers by process; empty if nobody but the oracle plays."""
    others: set[int] = field(default_factory=set)
    """Boot ids of processes that answered with other models."""

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns() if self.clock is not None else 0

    @property
    def servers(self) -> tuple[str, ...]:
        return servers_of(self.request.info.policy)

    @property
    def is_lockstep(self) -> bool:
        return self.request.info.schedule.mode == m.Mode.LOCKSTEP

    def out_of_time(self, observation: m.Observation) -> str:
        """Why an observation cannot be of this episode's present; "" if it can.

        A robot shows the next tick, whose instant may lie one period ahead, and never an earlier instant than before.
        """
        conductor, schedule = self.conductor, self.request.info.schedule
        may_count = conductor.stage != Stage.RUNNING and not self.is_lockstep  # before tick 0 a robot may stream
        early = schedule.control_hz if may_count else 0
        if observation.tick > conductor.tick + early:
            return f"tick {observation.tick} before tick {conductor.tick} was commanded"
        ahead_ns = max((observation.source_ns, *observation.captured_ns)) - self.now_ns
        if ahead_ns > 2 * NS_PER_S // schedule.control_hz:
            return f"tick {observation.tick} is dated {ahead_ns / 1e6:.0f} ms ahead of the episode's clock"
        oldest_ns = conductor.newest_source_ns if conductor.newest_source_ns is not None else -NS_PER_S
        if observation.tick >= conductor.newest_tick and observation.source_ns < oldest_ns:
            return f"tick {observation.tick} is dated {observation.source_ns} ns, before {oldest_ns} ns"
        return ""

    def show(self, tick: int, payload: bytes) -> None:
        """Keeps the newest observation, as it came."""
        if self.newest_payload:
            self.recent.append(self.newest_payload)
        self.newest_payload = payload
        stride = self.conductor.picture_stride_ticks if self.is_lockstep else 0
        if stride and tick % stride == 0:
            self.remembered.append(payload)
            self.remembered_bytes += len(payload)
        while self.remembered_bytes > MAX_RECENT_BYTES:  # older ones would not fit into the answer
            self.remembered_bytes -= len(self.remembered.popleft())

    def keep(self, query: m.Query) -> None:
        """Enters a query about the newest observation in the journal."""
        self.journal.append(
            m.JournalEntry(
                query=query.query, tick=query.tick, source_ns=query.source_ns, observation=self.newest_payload
            )
        )
        self.journal_bytes += len(self.newest_payload)

    def past(self) -> tuple[bytes, ...]:
        """The observations for a POUNCE that restarts, in order: the newest that fit into a message together."""
        past = [*self.remembered, *self.recent]
        sums = accumulate(len(payload) for payload in reversed(past))
        num = sum(total <= MAX_RECENT_BYTES for total in sums)
        return tuple(past)[len(past) - num :]
