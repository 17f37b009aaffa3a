"""The robot's end of the bus, between and around episodes: it opens them with the servers, and closes them.

The caller runs the episode in between: a simulation (`suite`), or a client of another protocol (`gateway.machine`).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from clock.obeyed import Obeyed
from clock.policies import has_ponder, servers_of
from clock.report import statistics, stream_sha256
from clock.schedules import HORIZON
from clock.service import ClockService
from dual_system.models.ponder.demo_sampling import PAPER_SAMPLING, DemoSampling
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import CallFailed, EpisodeRefused, TransportError
from protocol.link import Link, source_of
from protocol.process import host_clock_id
from protocol.topics import CLOSE, CONTRACT, OPEN, TIME, alive_key
from sim_client.recorder import Recorder

STOPPED_S = 3
"""Time after which an episode that the ladder stopped ends unless it is engaged again."""

_CONTRACT_NS = 5_000_000_000
_OPEN_NS = 130_000_000_000
_CLOSE_NS = 5_000_000_000
_ASK_AGAIN_NS = 200_000_000
_LAST_TICKS_NS = 1_000_000_000
_TURN_NS = 1_000_000
_TIME_TURN_S = 0.0005  # what the clocks' offset becomes uncertain by

Reply = TypeVar("Reply", m.ContractReply, m.OpenReply)


def stopped_reason(error: str) -> str:
    """Why an episode ends that the ladder stopped. ``error``: the last one that was told in it, or ""."""
    reason = "stopped by the ladder, and nobody engaged it again"
    return f"{reason}; the last error: {error}" if error else reason


def is_sound(link: Link, action: m.Action, obeyed: Obeyed, state: m.Floats | None) -> bool:
    """Whether this robot may be given a command: it has the last word on its own limits. If not, it is counted.

    ``state``: (num_proprio,), the newest that was measured; None: not known.
    """
    if why_not := obeyed.why_not(action, state):
        link.drop(source_of(action.header), DropReason.OUT_OF_LIMITS, why_not)
    return not why_not


class RobotEnd:
    """One robot, for any number of episodes one after the other.

    Args:
        link: the robot's identity on the bus.
        clock: the clock service, if it is embedded here; it is stepped while this thread waits.
        recorder: takes off the bus what belongs into results and logs.
        patience_ns: longest wait for servers to be ready.
        dead_server: a sentence if a server that we started is dead, else "".
        gives_up: whether to stop waiting before the patience is over.
    """

    def __init__(
        self,
        link: Link,
        clock: ClockService | None,
        recorder: Recorder,
        *,
        patience_ns: int,
        dead_server: Callable[[], str],
        gives_up: Callable[[], bool] = lambda: False,
    ) -> None:
        self.clock = clock
        self._link = link
        self._recorder = recorder
        self._patience_ns = patience_ns
        self._dead_server = dead_server
        self._gives_up = gives_up
        self._timing = link.serve(TIME)
        link.bus.declare_alive(alive_key(link.robot, link.proc))

    def tell_time(self) -> bool:
        """Answers those who ask for this host's clock; returns whether there were any."""
        return self._timing.answer(_time) > 0

    def demo_sampling(self, policy: str = "servers") -> DemoSampling | None:
        """Asks PONDER, or a POUNCE that plays alone, which frames of a demonstration it reads; None: nobody reads any.

        Raises:
            EpisodeRefused: it refuses the call.
            TransportError: it is not ready within the patience.
        """
        players = servers_of(policy)
        if not players:
            return None
        reply = self._patiently(lambda: self._ask_contract(players[0]))
        wanted = reply.contract.demonstrations if reply.contract is not None else None
        if wanted is None:
            return PAPER_SAMPLING if has_ponder(policy) else None
        return DemoSampling(hz=wanted.hz, to_its_end=wanted.to_its_end)

    def horizon(self) -> int:
        """Asks POUNCE how many rows its chunks have.

        Raises:
            EpisodeRefused: POUNCE refuses the call.
            TransportError: it is not ready within the patience.
        """
        contract = self._patiently(lambda: self._ask_contract("pounce")).contract
        return contract.horizon if contract is not None and contract.horizon else HORIZON

    def open(self, request: m.OpenRequest) -> m.OpenReply:
        """Opens the episode with every server, as soon as all are ready.

        Raises:
            EpisodeRefused: a server does not take it.
            TransportError: not ready within the patience.
        """
        with contextlib.nullcontext() if request.info.robot.is_simulated else self._telling_time():
            reply = self._patiently(lambda: self._ask_clock(request))
        self._link.admit(*(member for member in reply.members if member.proc != self._link.proc))
        return reply

    def take_turn(self, longest_ns: int) -> None:
        """Gives the other participants one turn; with an embedded clock, at most until it has something to do."""
        if self.clock is not None:
            if self.clock.step():
                return
            longest_ns = self.clock.wait_ns(longest_ns)
        self._link.bus.wait(longest_ns)

    def end(
        self, status: m.TaskStatus, reason: str, num_ticks: int, *, with_servers: bool = True
    ) -> tuple[m.EpisodeResult, list[str]]:
        """Ends the episode after ``num_ticks``: in the log, with the servers and here.

        Returns the result, and what is missing from the log.
        """
        self._await_ticks(num_ticks)
        ticks = [tick for tick in self._recorder.ticks if tick.tick < num_ticks]
        result = m.EpisodeResult(
            status=status,
            is_success=status == m.TaskStatus.SUCCESS,
            reason=reason,
            num_ticks=num_ticks,
            stream_sha256=stream_sha256(ticks),
            statistics=statistics(ticks, self._recorder.stamps, self._recorder.invocations),
        )
        missing = self._recorder.end(result)
        if with_servers:
            self._close(m.CloseRequest(header=self._link.header("close", 0), result=result))
        self._link.leave_episode()
        return result, missing

    @contextlib.contextmanager
    def _telling_time(self) -> Iterator[None]:
        """The clock service compares clocks within the call that opens an episode, for which this thread waits."""
        is_over = threading.Event()

        def tell() -> None:
            while not is_over.wait(_TIME_TURN_S):
                self.tell_time()

        thread = threading.Thread(target=tell, name="time", daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()

    def _patiently(self, ask: Callable[[], tuple[Reply, bool]]) -> Reply:
        """Asks until there is an answer. ``ask`` returns a reply, and whether to ask again because of its error."""
        deadline_ns = time.monotonic_ns() + self._patience_ns
        while True:
            reply, is_early = ask()
            if not reply.error:
                return reply
            if dead := self._dead_server():
                raise TransportError(dead)
            if not is_early:
                raise EpisodeRefused(getattr(reply, "refusal", m.Refusal.UNSPECIFIED), reply.error)
            if time.monotonic_ns() > deadline_ns or self._gives_up():
                raise TransportError(reply.error)
            self._recorder.step()
            self.take_turn(_ASK_AGAIN_NS)

    def _ask_contract(self, proc: str) -> tuple[m.ContractReply, bool]:
        try:
            return self._link.call(CONTRACT, proc, m.ContractRequest(), timeout_ns=_CONTRACT_NS), False
        except CallFailed as error:
            return m.ContractReply(error=str(error)), True

    def _ask_clock(self, request: m.OpenRequest) -> tuple[m.OpenReply, bool]:
        try:
            if self.clock is not None:  # our own thread: a call over the bus would wait for itself
                reply = self.clock.open(request)
            else:
                reply = self._link.call(OPEN, "clock", request, timeout_ns=_OPEN_NS)
        except CallFailed as error:
            return m.OpenReply(error=str(error)), True
        return reply, reply.try_again

    def _close(self, request: m.CloseRequest) -> None:
        if self.clock is not None:
            self.clock.close(request)
        else:
            with contextlib.suppress(CallFailed):  # the log already has the clock's loss
                self._link.call(CLOSE, "clock", request, timeout_ns=_CLOSE_NS)

    def _await_ticks(self, num_ticks: int) -> None:
        """Accounts of ticks travel behind their actions; the hash is over all of them."""
        deadline_ns = time.monotonic_ns() + _LAST_TICKS_NS
        self._recorder.step()
        while len(self._recorder.ticks) < num_ticks and time.monotonic_ns() < deadline_ns:
            self.take_turn(_TURN_NS)
            self._recorder.step()


def _time(request: m.TimeRequest) -> m.TimeReply:
    now_ns = time.monotonic_ns()
    return m.TimeReply(clock_id=host_clock_id(), t1_ns=now_ns, t2_ns=now_ns)
