"""A model server's membership in an episode: the clock service opens and closes it, and a restarted server catches up.

It calls three functions of the server and handles identity, heartbeat and refusals in one place.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from protocol import messages as m
from protocol.errors import CallFailed, EpisodeRefused, ProtocolError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.topics import ACTIVE, CLOSE, CONTRACT, JOURNAL, OPEN, TIME, alive_key

log = logging.getLogger(__name__)

JOURNAL_PAGE = 4  # observations per call: 1.6 MB of two raw 256 px views
_CALL_NS = 2_000_000_000
_ASK_AGAIN_NS = 1_000_000_000
_CLOCK_SILENCE_NS = 2_000_000_000
_LOST_REQUEST_NS = 1_000_000_000
"""Lockstep: silence of the clock service after which a request may have been lost on its way, or its answer."""

Describe = Callable[[], m.Contract]
Open = Callable[[m.OpenRequest], m.Contract]
Close = Callable[[], None]


class Membership:
    """Keeps one server in the episode that the clock service runs.

    Args:
        contract: returns the server's contract for any episode; raises ValueError if there is none yet.
        open_episode: starts the episode in the engine and returns a contract; raises ValueError to refuse.
        close_episode: ends the episode; called also before a new one.
    """

    def __init__(
        self, link: Link, heartbeat: Heartbeat, contract: Describe, open_episode: Open, close_episode: Close
    ) -> None:
        self._link = link
        self._heartbeat = heartbeat
        self._contract = contract
        self._open_episode = open_episode
        self._close_episode = close_episode
        self._asking = link.serve(CONTRACT)
        self._opening = link.serve(OPEN)
        self._closing = link.serve(CLOSE)
        self._timing = link.serve(TIME)
        self._ask_again_ns = 0
        self._asked: Callable[[], m.ActiveReply | None] | None = None
        self._clocks = link.bus.watch_alive(alive_key(link.robot, "clock"))
        self._is_clock_there = False
        self._clock_lost_ns = 0
        self._refused = ""
        self._left = ""
        self._is_lockstep = False
        self._is_draining = False

    def drain(self) -> bool:
        """Opens no more episodes from now on; returns whether none runs."""
        if not self._is_draining:
            log.info("draining robot=%s episode=%s", self._link.robot, self._link.episode or "none")
        self._is_draining = True
        return not self._link.episode or self._is_clock_gone()

    def step(self) -> bool:
        """Answers waiting calls; returns whether there were any."""
        for sample in self._clocks.drain():
            self._is_clock_there = bool(sample.payload)
            if not self._is_clock_there:
                self._clock_lost_ns = time.monotonic_ns()
        answered = self._opening.answer(self._on_open) + self._closing.answer(self._on_close)
        return answered + self._asking.answer(self._on_contract) + self._timing.answer(_on_time) > 0

    @property
    def may_have_missed_one(self) -> bool:
        """Whether an episode may run without this server: it is in none, and there is a clock service."""
        return self._is_clock_there and not self._link.episode

    @property
    def is_asking(self) -> bool:
        """Whether the clock service's word on the running episode is still to come."""
        return self._asked is not None

    def leave(self) -> None:
        """Ends the running episode here for good, and asks the clock service for another one at once: for shadows."""
        if self._link.episode:
            self._left = self._link.episode
            self._leave()
        self._ask_again_ns = 0

    def rejoin(self) -> m.ActiveReply | None:
        """Asks the clock service for the running episode, at most once a second, and opens it here.

        Returns the clock service's reply once it is there; None before, and if no episode runs or this server is in it.
        """
        if self._link.episode and not self._is_clock_gone():
            return None  # what another clock says of its episode is no reason to leave this one
        reply = self._active()
        if reply is None:
            return None
        if reply.error != self._refused:
            self._refused = reply.error
            log.log(logging.ERROR if reply.error else logging.INFO, "rejoin %s", reply.error or "is possible again")
        if reply.open is None or reply.open.info.header.episode in (self._link.episode, self._left):
            return None
        opened = self._on_open(reply.open, announce=False)
        if opened.error:
            log.error("rejoin refused=%s", opened.error)
            return None
        log.info("rejoin episode=%s queries=%d", self._link.episode, reply.num_queries)
        return reply

    def owed(self) -> m.ActiveReply | None:
        """What the clock service waits for from this server; None if it does not, or has not said so yet.

        Only in lockstep does the world wait for an answer that a broken link swallowed; in real time it asks anew.
        """
        is_silent = self._link.silent_ns("clock") > _LOST_REQUEST_NS
        if not (self._link.episode and self._is_lockstep and self._is_clock_there and is_silent):
            self._asked = None if self._link.episode else self._asked  # what was owed then may be answered by now
            return None
        reply = self._active()
        is_ours = reply is not None and reply.open is not None and reply.open.info.header.episode == self._link.episode
        return reply if is_ours else None

    def _active(self) -> m.ActiveReply | None:
        """The clock service's word on the running episode, asked at most once a second; None while there is none.

        Nobody waits for it here: a clock that is busy with an opening would hold up the other robots of this server.
        """
        now_ns = time.monotonic_ns()
        if self._asked is None:
            if now_ns < self._ask_again_ns:
                return None
            self._ask_again_ns = now_ns + _ASK_AGAIN_NS
            self._asked = self._link.ask(ACTIVE, "clock", m.ActiveRequest(), timeout_ns=_CALL_NS)
        try:
            reply = self._asked()
        except CallFailed:  # no clock service, hence no episode
            self._asked = None
            return None
        if reply is not None:
            self._asked = None
        return reply  # type: ignore[no-any-return]

    def journal(self, num_queries: int, first: int = 0) -> Iterator[m.JournalEntry]:
        """The episode's queries from ``first`` up to ``num_queries``, with their observations, oldest first.

        Raises:
            CallFailed: the clock service stopped answering.
            ProtocolError: it no longer runs this episode.
        """
        while first < num_queries:
            # Not beyond num_queries: the journal grows, and newer queries arrive as messages.
            request = m.JournalRequest(first_query=first, max_queries=min(JOURNAL_PAGE, num_queries - first))
            reply = self._link.call(JOURNAL, "clock", request, timeout_ns=_CALL_NS)
            if reply.error or not reply.entries:
                raise ProtocolError(reply.error or f"the journal ends at query {first} of {num_queries}")
            yield from reply.entries
            first += len(reply.entries)

    def announce(self) -> None:
        """Informs the clock service that this server is in the episode."""
        self._heartbeat.set(open_episode=self._link.episode)

    def _on_open(self, request: m.OpenRequest, *, announce: bool = True) -> m.OpenReply:
        header = request.info.header
        if self._link.episode and not self._may_end(_clock_of(request.members)):
            error = f"it is in episode {self._link.episode}, whose clock is there"
            return m.OpenReply(error=error, refusal=m.Refusal.BUSY, try_again=True)
        if self._link.episode:
            self._leave()
        if self._is_draining:
            error = "it is draining: it leaves after its last episode, and another process takes its place"
            return m.OpenReply(error=error, refusal=m.Refusal.NOT_READY, try_again=True)
        self._asked = None  # what the clock says of the time before comes too late
        try:
            self._link.enter_episode(header.session, header.episode, header.epoch, request.members)
            contract = replace(self._open_episode(request), boot_id=self._link.boot_id)
            self._clock_lost_ns = 0
            self._is_lockstep = request.info.schedule.mode == m.Mode.LOCKSTEP
        except ValueError as error:
            self._leave()
            if isinstance(error, EpisodeRefused):
                return m.OpenReply(error=str(error), refusal=error.refusal, try_again=error.try_again)
            return m.OpenReply(error=str(error), refusal=m.Refusal.REQUEST)
        except Exception:  # a bug: the episode is not half open afterwards
            self._leave()
            raise
        if announce:
            self.announce()
        return m.OpenReply(contract=contract)

    def _on_contract(self, request: m.ContractRequest) -> m.ContractReply:
        try:
            return m.ContractReply(contract=self._contract())
        except ValueError as error:
            return m.ContractReply(error=str(error))

    def _on_close(self, request: m.CloseRequest) -> m.CloseReply:
        if request.header.episode != self._link.episode:
            return m.CloseReply(error=f"episode {request.header.episode!r} is not open here")
        if self._link.episode and not self._may_end(request.header.boot_id):
            return m.CloseReply(error="only the clock that opened an episode can close it")
        if self._link.episode:
            self._leave()
        return m.CloseReply()

    def _may_end(self, boot_id: int) -> bool:
        """Whether the running episode may be ended by this clock: its own, or any once its own is gone."""
        return boot_id == self._link.members.get("clock") or self._is_clock_gone()

    def _is_clock_gone(self) -> bool:
        """Whether this episode's clock lost its token and was not heard since: a successor's token says nothing."""
        silent_ns = self._link.silent_ns("clock")
        return silent_ns > _CLOCK_SILENCE_NS and time.monotonic_ns() - silent_ns < self._clock_lost_ns

    def _leave(self) -> None:
        self._asked = None
        self._close_episode()
        self._link.leave_episode()
        self._heartbeat.set(open_episode="")


def _clock_of(members: tuple[m.Member, ...]) -> int:
    return next((member.boot_id for member in members if member.proc == "clock"), 0)


def _on_time(request: m.TimeRequest) -> m.TimeReply:
    now_ns = time.monotonic_ns()
    return m.TimeReply(clock_id=host_clock_id(), t1_ns=now_ns, t2_ns=now_ns)
