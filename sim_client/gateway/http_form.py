"""The challenge over HTTP: ``GET /healthz`` and ``/metadata``, ``POST /reset`` and ``/infer``, bodies in msgpack.

The standard library's server: a handful of requests a second, a thread each, no dependency more. HTTP has no
connection to tell clients apart by, so a client is a host, or one of its sessions if it names them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from protocol.errors import TransportError
from sim_client.gateway.arrays import pack
from sim_client.gateway.challenge import RESET_FINISHED
from sim_client.gateway.exchange import Busy, Dialect, Door, Failed, Finish, Packet, Terms, refusal
from sim_client.gateway.memory import Memory
from sim_client.gateway.openpi import metadata
from sim_client.gateway.websocket import KEY_WANTED, is_allowed, route

log = logging.getLogger("pp-gateway")

SESSION_HEADER = "X-Session-Id"
_STATUS = {Busy: HTTPStatus.SERVICE_UNAVAILABLE, Failed: HTTPStatus.INTERNAL_SERVER_ERROR}
"""Status of a refusal; every other one is a bad request."""
_NO_ID = re.compile(r"[^A-Za-z0-9_.-]+")
_SILENT_S = 60.0  # a body that stops arriving does not hold its thread


class HttpSide(ThreadingHTTPServer):
    """Serves the challenge's HTTP form until ``shutdown``.

    Raises:
        TransportError: the address cannot be listened on.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self,
        address: tuple[str, int],
        door: Door,
        terms: Terms,
        new_dialect: Callable[[Terms], Dialect],
        max_bytes: int,
        api_key: str = "",
        memory: Memory | None = None,
    ) -> None:
        self.door, self.terms, self.new_dialect = door, terms, new_dialect
        self.max_bytes, self.api_key, self.memory = max_bytes, api_key, memory or Memory()
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise TransportError(f"--listen {address[0]}:{address[1]}: {error}") from None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = _SILENT_S
    server: HttpSide

    def do_GET(self) -> None:
        if self._route == "/healthz":
            self._say(HTTPStatus.OK, "OK\n")
        elif not self._is_allowed():
            self._say(HTTPStatus.UNAUTHORIZED, KEY_WANTED)
        elif self._route == "/metadata":
            self._say(HTTPStatus.OK, pack(metadata(self.server.terms), "openpi"))
        else:
            self._say(HTTPStatus.NOT_FOUND, "expected /healthz or /metadata\n")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        if not self._is_allowed():
            self._leave_body(HTTPStatus.UNAUTHORIZED, KEY_WANTED)
        elif self._route not in ("/reset", "/infer"):
            self._leave_body(HTTPStatus.NOT_FOUND, "expected /reset or /infer\n")
        elif (body := self._body()) is not None:
            try:
                self._say(*self._answered(body))
            finally:
                self.server.memory.give(self)

    def _answered(self, body: bytes) -> tuple[HTTPStatus, Packet]:
        try:
            return HTTPStatus.OK, self._done(body)
        except Exception as error:
            refused = refusal(error, self._client)
            return _STATUS.get(type(refused), HTTPStatus.BAD_REQUEST), f"{refused}\n"

    def _done(self, body: bytes) -> Packet:
        """Raises whatever reading and playing raise."""
        door, dialect = self.server.door, self.server.new_dialect(self.server.terms)
        if self._route == "/reset":
            door.submit(self._client, Finish()).result()
            return pack(RESET_FINISHED, "openpi")
        asked = dialect.read(body)
        answer = door.submit(self._client, asked.request).result() if asked.request is not None else None
        return dialect.answer(asked, answer) if answer is not None else asked.reply or b""

    def _body(self) -> bytes | None:
        """The request's bytes; None if it was refused already."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            self._leave_body(HTTPStatus.LENGTH_REQUIRED, "expected a Content-Length\n")
            return None
        if int(length) > self.server.max_bytes:
            limit = f"{self.server.max_bytes} bytes"
            self._leave_body(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {limit}, came {length}: see --max-message-mb\n"
            )
            return None
        memory = self.server.memory
        if memory.take(self, int(length)) is not None:  # a request has no holder to close: the one that comes loses
            memory.give(self)
            self._leave_body(HTTPStatus.SERVICE_UNAVAILABLE, f"{memory.sentence}\n")
            return None
        try:
            return self.rfile.read(int(length))
        except BaseException:
            memory.give(self)
            raise

    def _leave_body(self, status: HTTPStatus, text: str) -> None:
        """Refuses without reading on: what follows on this connection could be anything, so it is closed."""
        self.close_connection = True
        self._say(status, text)

    def _say(self, status: HTTPStatus, content: Packet) -> None:
        body = content.encode() if isinstance(content, str) else content
        self.send_response(status)
        self.send_header("Content-Type", "text/plain" if isinstance(content, str) else "application/msgpack")
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    @property
    def _route(self) -> str:
        return route(self.path)

    @property
    def _client(self) -> str:
        session = _NO_ID.sub("", self.headers.get(SESSION_HEADER, ""))[:60]
        return f"{self.client_address[0]} over HTTP{session and f', session {session}'}"

    def _is_allowed(self) -> bool:
        return is_allowed(self.headers.get("Authorization"), self.server.api_key)

    def log_message(self, format: str, *args: object) -> None:
        log.debug("client=%s %s", self._client, format % args)
