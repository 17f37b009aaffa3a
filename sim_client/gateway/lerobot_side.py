"""LeRobot's transport: a zenoh session of its own, in a thread of its own.

Its clients speak neither TLS nor a key, so it listens on loopback only; elsewhere a tunnel is needed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from protocol.bus import Bus, Request
from protocol.errors import TransportError
from protocol.peers.lerobot import (
    Code,
    Envelope,
    WireError,
    deployment_key,
    instance_key,
    pack,
    session_key,
    unpack,
)
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus, is_loopback
from sim_client.gateway.exchange import Answer, Busy, Finish, Refused, Terms, refusal
from sim_client.gateway.lerobot import Deployment, Session
from sim_client.gateway.seats import Seats

log = logging.getLogger("pp-gateway")

_IDLE_NS = 50_000_000
_LEASE_MS = 10_000  # zenoh's own: a server's token that was gone for a moment ends the client's run
_KEEP_PER_SEAT = 4


@dataclass(slots=True)
class _Pending:
    """A message whose answer waits for a seat."""

    asked: Envelope
    session: Session
    future: Future[Answer | None]
    reply: Callable[[bytes], None]
    done: Envelope | None = None  # what to reply when the future has no answer


class LerobotSide:
    """Serves one deployment until ``shutdown``.

    Raises:
        TransportError: the address cannot be listened on, or other hosts could reach it.
    """

    def __init__(self, address: tuple[str, int], seats: Seats, terms: Terms, num_seats: int) -> None:
        host, port = address
        where = f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}"
        if not is_loopback(where):
            raise TransportError(
                f"--listen {host}:{port}: LeRobot's wire has no key and no TLS; use a tunnel to loopback"
            )
        self._seats = seats
        self.deployment = Deployment(terms, num_seats)
        self._bus: Bus = ZenohBus(Endpoints(listen=(where,), lease_ms=_LEASE_MS))
        self._pending: list[_Pending] = []
        self._should_stop = threading.Event()
        root = instance_key(self.deployment.name, self.deployment.instance_id)
        keep = _KEEP_PER_SEAT * num_seats
        self._describes = self._bus.serve(f"{deployment_key(self.deployment.name)}/describe")
        self._opens = self._bus.serve(f"{root}/open")
        self._controls = self._bus.serve(f"{root}/sessions/*/control")
        self._observations = self._bus.subscribe(f"{root}/sessions/*/obs", keep=keep)
        self._questions = self._bus.subscribe(f"{root}/sessions/*/language/request", keep=keep)
        self._tokens = self._bus.watch_alive(f"{root}/sessions/*/alive")
        self._bus.declare_alive(f"{root}/alive")

    def serve_forever(self) -> None:
        try:
            while not self._should_stop.is_set():
                self._bus.wait(_IDLE_NS)
                self._turn()
        finally:
            for session in [*self.deployment.sessions.values()]:
                self._forget(session, "the gateway was stopped")
            self._bus.close()

    def shutdown(self) -> None:
        self._should_stop.set()
        self._bus.ring()

    def _turn(self) -> None:
        self._look_after_absent()
        for inbox in (self._describes, self._opens, self._controls):
            for request in inbox.drain():
                self._handle(request)
        for samples, channel in ((self._observations, "act"), (self._questions, "language/result")):
            for sample in samples.drain():
                session_id = sample.key.split("/sessions/")[1].partition("/")[0]
                self._handle(Request(sample.payload, self._publisher(session_id, channel)))
        self._reply()

    def _publisher(self, session_id: str, channel: str) -> Callable[[bytes], None]:
        key = f"{session_key(self.deployment.name, self.deployment.instance_id, session_id)}/{channel}"
        return lambda data: self._bus.publish(key, data, encoding="", attachment=b"", priority=Priority.DATA)

    def _handle(self, request: Request) -> None:
        """Answers one message, now or later. Whatever it is, it does not end this thread."""
        asked: Envelope | None = None
        try:
            asked = unpack(request.payload)
            self._take(asked, request.reply)
        except Exception as error:
            self._refuse(asked or getattr(error, "asked", None) or Envelope(kind="error"), error, request.reply)

    def _refuse(self, asked: Envelope, error: Exception, reply: Callable[[bytes], None]) -> None:
        if isinstance(error, WireError):
            log.warning("LeRobot session=%s %s %s: %s", asked.session_id or "-", asked.kind, error.code, error)
        else:
            refused = refusal(error, f"LeRobot's session {asked.session_id[:8] or '-'}, {asked.kind}")
            error = WireError(Code.BUSY if isinstance(refused, Busy) else Code.EXECUTION, str(refused))
        reply(pack(asked.error(error)))

    def _take(self, asked: Envelope, reply: Callable[[bytes], None]) -> None:
        if asked.kind in ("describe", "open"):
            unready, models = self._seats.unready(), self._seats.models
            if asked.kind == "describe":
                reply(pack(self.deployment.described(asked, unready, models)))
                return
            accepted = self.deployment.admitted(asked, unready, models, time.monotonic_ns())
            log.info("LeRobot session=%s admitted", accepted.session_id)
            reply(pack(accepted))
        elif asked.kind == "control":
            self._control(asked, reply)
        elif asked.kind in ("observation", "language_request"):
            session = self.deployment.session(asked)
            if any(each.asked.generation == session.generation for each in self._pending if each.session is session):
                raise WireError(Code.BUSY, "an observation of this session is being answered")
            step = session.observed(asked)
            self._wait_for(_Pending(asked, session, self._seats.submit(_client(session), step), reply))
        else:
            raise WireError(Code.MALFORMED, f"{asked.kind}: expected what a client sends")

    def _control(self, asked: Envelope, reply: Callable[[bytes], None]) -> None:
        session = self.deployment.session(asked)
        before = session.generation
        operation, ack = session.controlled(asked)
        if operation == "close":
            self._forget(session, "the client left")
        if operation != "reset" or session.generation == before or not session.has_begun:
            reply(pack(ack))
            return
        session.reset()
        finish = Finish(reason="LeRobot's client began anew")
        self._wait_for(_Pending(asked, session, self._seats.submit(_client(session), finish), reply, ack))

    def _wait_for(self, pending: _Pending) -> None:
        self._pending.append(pending)
        pending.future.add_done_callback(lambda _: self._bus.ring())

    def _reply(self) -> None:
        for each in [each for each in self._pending if each.future.done()]:
            self._pending.remove(each)
            if each.done is None and each.asked.generation != each.session.generation:
                continue  # the client has given it up, and takes any error as the end
            try:
                answer = each.future.result()
                told = each.done if answer is None else each.session.answered(each.asked, answer)
                each.reply(pack(told if told is not None else each.asked))
            except Exception as error:
                self._refuse(each.asked, error, each.reply)

    def _look_after_absent(self) -> None:
        now_ns = time.monotonic_ns()
        for token in self._tokens.drain():
            session_id = token.key.split("/sessions/")[1].partition("/")[0]
            if (session := self.deployment.sessions.get(session_id)) is not None:
                is_there = bool(token.payload)
                session.was_present |= is_there
                session.absent_since_ns = None if is_there else now_ns
        for session in [*self.deployment.sessions.values()]:
            if session.grace_s(now_ns) == 0:
                self._forget(session, "the client was absent")

    def _forget(self, session: Session, why: str) -> None:
        self.deployment.sessions.pop(session.id, None)
        log.info("LeRobot session=%s over: %s", session.id, why)
        try:
            self._seats.submit(_client(session), Finish(reason=why))
        except Refused:
            return  # the gateway is being stopped, and ends the episode itself


def _client(session: Session) -> str:
    return f"LeRobot's session {session.id[:8]}"
