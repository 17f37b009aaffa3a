"""The clock service's calls to the servers of an episode: are they there, how late are their clocks, open, close."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from clock.offset import Offset, from_exchange, narrowest
from clock.timebase import MonotonicClock
from clock.watch import Watch
from protocol import messages as m
from protocol.errors import CallFailed, EpisodeRefused, ProtocolError
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.topics import CLOSE, OPEN, TIME

log = logging.getLogger(__name__)

NUM_TIME_EXCHANGES = 8
OPEN_NS = 120_000_000_000  # a long demonstration is encoded inside this call
_CALL_NS = 2_000_000_000


@dataclass(slots=True, kw_only=True)
class Servers:
    """Every call waits for its reply: none is made while rows are played."""

    link: Link
    host: MonotonicClock
    watch: Watch
    watches: bool
    """False if all participants share one thread, so that none can be missing."""
    max_clock_bound_ns: int
    offsets: dict[str, Offset] = field(default_factory=dict)
    """Offset of each process's clock against this one, as measured for the newest episode."""

    def not_ready(self, procs: Sequence[str]) -> str:
        """Why no episode of these servers can be opened, unless one runs already; "" if one can."""
        for proc in procs:
            health = self.watch.health_of(proc)
            if health is None:
                return f"{proc} is not there: start {proc}-serve, or check its endpoint"
            if self.watch.has_rival(proc, self.host.now_ns()):
                return f"two processes answer to the name of {proc}: stop one of them"
            if health.state == m.ServingState.FAILED:
                return f"{proc} failed: {health.detail}"
            if health.state != m.ServingState.READY:
                return f"{proc} is {health.state.name.lower()} ({health.progress:.0%}) {health.detail}".strip()
        return ""

    def members(self) -> tuple[m.Member, ...]:
        return tuple(m.Member(proc=proc, boot_id=boot_id) for proc, boot_id in self.link.members.items())

    def measure_offsets(self, procs: Sequence[str]) -> None:
        """Raises CallFailed without an answer, ProtocolError if another host's clock offset is too uncertain."""
        self.offsets = {}
        for proc in procs:
            exchanges = []
            clock_id = ""
            for _ in range(NUM_TIME_EXCHANGES):
                t0_ns = self.host.now_ns()
                reply = self.link.call(TIME, proc, m.TimeRequest(t0_ns=t0_ns), timeout_ns=_CALL_NS)
                try:
                    exchanges.append(from_exchange(t0_ns, reply.t1_ns, reply.t2_ns, self.host.now_ns()))
                except ValueError as error:
                    raise ProtocolError(f"the clock of {proc} ({reply.clock_id}): {error}") from None
                clock_id = reply.clock_id
            offset = narrowest(exchanges)
            if clock_id != host_clock_id() and offset.bound_ns > self.max_clock_bound_ns:
                raise ProtocolError(
                    f"the clock of {proc} ({clock_id}) is known to {offset.bound_ns / 1e6:.2f} ms only, the limit is "
                    f"{self.max_clock_bound_ns / 1e6:.2f} ms. Use a quieter link or --max-clock-bound-ms."
                )
            self.offsets[proc] = offset

    def open(self, proc: str, request: m.OpenRequest) -> m.Contract:
        """Opens the episode at a server. Raises EpisodeRefused if it refuses, CallFailed if it does not answer."""
        reply = self.link.call(OPEN, proc, replace(request, members=self.members()), timeout_ns=OPEN_NS)
        contract: m.Contract | None = reply.contract
        if reply.error or contract is None:
            why = reply.error or "it sent no contract"
            raise EpisodeRefused(reply.refusal, f"{proc} refuses the episode: {why}", try_again=reply.try_again)
        self.link.admit(m.Member(proc=proc, boot_id=contract.boot_id))
        return contract

    def close(self, procs: Sequence[str], result: m.EpisodeResult | None) -> None:
        """Closes the episode at every server that is there."""
        for proc in procs:
            if self.watches and (self.watch.is_lost(proc) or self.watch.is_gone(proc)):
                continue
            try:
                self.link.call(CLOSE, proc, m.CloseRequest(result=result), timeout_ns=_CALL_NS)
            except CallFailed as error:
                log.warning("close proc=%s %s", proc, error)
