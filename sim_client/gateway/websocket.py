"""The websocket server: one task per connection, which reads requests, submits them and sends the answers."""

from __future__ import annotations

import asyncio
import contextlib
import http
import json
import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from protocol.errors import TransportError
from protocol.messages import Mode
from sim_client.gateway import reading
from sim_client.gateway.exchange import Answer, ClientRequest, Dialect, Door, Finish, Packet, Refused, Terms, refusal
from sim_client.gateway.memory import Memory, counted
from sim_client.gateway.openpi import metadata

log = logging.getLogger("pp-gateway")

_PING_S = 20.0
LIVE_UNDER_WAY = 16
"""A client that asks faster than it is answered waits: what it has sent is not stored without end."""


@dataclass(frozen=True, slots=True)
class WebsocketSide:
    """Serves one dialect. ``api_key``: the key that clients must send; "" admits all."""

    door: Door
    terms: Terms
    new_dialect: Callable[[Terms], Dialect]
    max_bytes: int
    api_key: str = ""
    memory: Memory = field(default_factory=Memory)

    async def start(self, host: str, port: int) -> Server:
        """Listens until the server is closed.

        Raises:
            TransportError: the address cannot be listened on.
        """
        try:
            return await serve(
                self._converse,
                host,
                port,
                process_request=self._answer_http,
                compression=None,  # pixels: deflate costs more than it saves
                max_size=self.max_bytes,
                create_connection=counted(self.memory),
                ping_interval=_PING_S,
                ping_timeout=None,  # a client that resets its simulator answers no ping for minutes
            )
        except OSError as error:
            raise TransportError(f"--listen {host}:{port}: {error}") from None

    def _answer_http(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers health checks and metadata requests in plain HTTP; None lets the websocket begin."""
        path = route(request.path)
        if path in ("/healthz", "/health"):
            status, text = http.HTTPStatus.OK, "OK\n"
        elif not is_allowed(request.headers.get("Authorization"), self.api_key):
            status, text = http.HTTPStatus.UNAUTHORIZED, KEY_WANTED
        elif path == "/metadata":
            status, text = http.HTTPStatus.OK, json.dumps(metadata(self.terms)) + "\n"
        else:
            return None
        response = connection.respond(status, text)
        if getattr(request, "method", "GET") == "HEAD":  # older websockets know GET alone
            response.body = b""
        return response

    async def _converse(self, connection: ServerConnection) -> None:
        host, port, *_ = connection.remote_address
        client = f"{host}:{port}"
        dialect = self.new_dialect(self.terms)
        under_way: set[asyncio.Task[None]] = set()
        closed = asyncio.ensure_future(connection.wait_closed())
        log.info("client=%s connected", client)
        try:
            if (greeting := dialect.greeting()) is not None:
                await connection.send(greeting)
            async for packet in connection:
                try:
                    asked = await asyncio.to_thread(dialect.read, packet)
                    future = self.door.submit(client, asked.request) if asked.request is not None else None
                except Exception as error:
                    await connection.send(dialect.refuse(str(refusal(error, client))))
                    continue
                task = asyncio.create_task(self._reply(connection, client, dialect, asked, future))
                under_way.add(task)
                task.add_done_callback(under_way.discard)
                while len(under_way) >= self._most_under_way:
                    await asyncio.wait({*under_way, closed}, return_when=asyncio.FIRST_COMPLETED)
                    if closed.done():
                        break
        except ConnectionClosed as error:
            log.info("client=%s closed: %s", client, error)
        finally:
            for task in (*under_way, closed):
                task.cancel()
            with contextlib.suppress(Refused):  # the gateway is being stopped, and ends the episode itself
                self.door.submit(client, Finish(reason="the client left"))
            log.info("client=%s left", client)

    @property
    def _most_under_way(self) -> int:
        """Requests of one client before the next is read. Live, a new observation waits for no old answer."""
        return 1 if self.terms.mode == Mode.LOCKSTEP else LIVE_UNDER_WAY

    async def _reply(
        self,
        connection: ServerConnection,
        client: str,
        dialect: Dialect,
        asked: ClientRequest,
        future: Future[Answer | None] | None,
    ) -> None:
        try:
            answer = await asyncio.wrap_future(future) if future is not None else None
            packet: Packet | None = asked.reply if answer is None else dialect.answer(asked, answer)
        except Exception as error:
            packet = dialect.refuse(str(refusal(error, client)))
        if packet is not None:
            try:
                await connection.send(packet)
            except ConnectionClosed:
                return  # the conversation's own loop reports it


def route(path: str) -> str:
    """The path of a request without its query and without slashes at its end."""
    return path.partition("?")[0].rstrip("/")


KEY_WANTED = "expected the header Authorization: Api-Key WORD, with the word in --api-key-file\n"


def is_allowed(authorization: str | None, api_key: str) -> bool:
    """Whether a client is admitted."""
    return not api_key or reading.is_secret(authorization, f"Api-Key {api_key}")
