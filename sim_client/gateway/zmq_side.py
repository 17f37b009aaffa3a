"""GR00T's transport: a ZMQ socket for requests and replies, in a thread of its own.

ZMQ says nothing of clients that come and go, and a client that gave up a request comes back with a new socket. So a
client is a host, as over HTTP, and loses the robot when it has been silent for ``--idle-s``.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from typing import NamedTuple

import zmq

from protocol.errors import TransportError
from sim_client.gateway.exchange import Answer, ClientRequest, Dialect, Door, Packet, Terms, refusal

log = logging.getLogger("pp-gateway")

_IDLE_MS, _PENDING_MS = 50, 2
_MAX_WAITING = 4  # requests of one client that are not read yet
_MAX_CLIENTS = 64


class _Pending(NamedTuple):
    """A request whose answer is awaited."""

    identity: bytes
    client: str
    dialect: Dialect
    asked: ClientRequest
    future: Future[Answer | None]


class ZmqSide:
    """Serves one dialect until ``shutdown``.

    Raises:
        TransportError: the address cannot be listened on.
    """

    def __init__(
        self,
        address: tuple[str, int],
        door: Door,
        terms: Terms,
        new_dialect: Callable[[Terms], Dialect],
        max_bytes: int,
    ) -> None:
        self._door, self._terms, self._new_dialect = door, terms, new_dialect
        self._dialects: OrderedDict[str, Dialect] = OrderedDict()
        self._pending: list[_Pending] = []
        self._should_stop = threading.Event()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, max_bytes)
        self._socket.setsockopt(zmq.RCVHWM, _MAX_WAITING)
        host, port = address
        self._socket.setsockopt(zmq.IPV6, ":" in host)
        where = f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"
        try:
            self._socket.bind(where)
        except zmq.ZMQError as error:
            self._socket.close()
            raise TransportError(f"--listen {host}:{port}: {error}; expected an address of this host") from None
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])

    def serve_forever(self) -> None:
        try:
            while not self._should_stop.is_set():
                if self._socket.poll(_PENDING_MS if self._pending else _IDLE_MS):
                    self._receive()
                self._reply()
        finally:
            self._socket.close()

    def shutdown(self) -> None:
        self._should_stop.set()

    def _receive(self) -> None:
        frames = self._socket.recv_multipart(copy=False)
        if len(frames) != 3 or len(frames[1]):  # a REQ socket sends its identity, nothing, and the message
            log.warning("dropped a message of %d frames: expected a REQ socket's", len(frames))
            return
        identity, packet = frames[0].bytes, frames[2].bytes
        client = f"{frames[2].get('Peer-Address')} over ZMQ"
        dialect = self._dialect(client)
        try:
            asked = dialect.read(packet)
            if asked.request is None:
                self._send(identity, asked.reply)
                return
            self._pending.append(_Pending(identity, client, dialect, asked, self._door.submit(client, asked.request)))
        except Exception as error:
            self._send(identity, dialect.refuse(str(refusal(error, client))))

    def _reply(self) -> None:
        for each in [each for each in self._pending if each.future.done()]:
            self._pending.remove(each)
            try:
                answer = each.future.result()
                packet = each.asked.reply if answer is None else each.dialect.answer(each.asked, answer)
            except Exception as error:
                packet = each.dialect.refuse(str(refusal(error, each.client)))
            self._send(each.identity, packet)

    def _send(self, identity: bytes, packet: Packet | None) -> None:
        data = packet.encode() if isinstance(packet, str) else packet or b""
        self._socket.send_multipart([identity, b"", data])  # a client that left gets nothing, and nobody waits for it

    def _dialect(self, client: str) -> Dialect:
        if client not in self._dialects:
            self._dialects[client] = self._new_dialect(self._terms)
        self._dialects.move_to_end(client)
        while len(self._dialects) > _MAX_CLIENTS:
            self._dialects.popitem(last=False)
        return self._dialects[client]
