"""A websocket to a policy server, on which nothing waits without a limit."""

from __future__ import annotations

import contextlib
import socket
import struct
from concurrent.futures import Future, ThreadPoolExecutor, wait
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

from pounce_server.remote.peer import Lost, Patience, PeerError

_OPEN_S = 5.0
_STUCK_US = 400_000  # a frozen server reads nothing: a send must not wait for it
_MAX_BYTES = 64 << 20


class Socket:
    """Connects when it is first used. Whatever goes wrong closes it, so no late answer is taken for the next one."""

    def __init__(self, url: str, headers: dict[str, str]) -> None:
        """Raises ValueError unless ``url`` is a websocket's."""
        if urlsplit(url).scheme not in ("ws", "wss") or not urlsplit(url).hostname:
            raise ValueError(f"--url {url}: expected ws://HOST:PORT or wss://HOST:PORT, with a path if it has one")
        self._url, self._headers = url, headers
        self._connection: ClientConnection | None = None

    @property
    def is_open(self) -> bool:
        return self._connection is not None

    def open(self, patience: Patience) -> None:
        """Raises PeerError: no websocket in time. Raises Lost, OSError: there is none."""
        pool = ThreadPoolExecutor(1)  # names are looked up, and TLS is agreed on, without a heartbeat of ours
        opening = pool.submit(self._opened)
        pool.shutdown(wait=False)
        try:
            while not opening.done():
                wait([opening], patience.look_s())
        except PeerError:
            opening.add_done_callback(_leave)
            raise
        self._connection = opening.result()

    def _opened(self) -> ClientConnection:
        where = urlsplit(self._url)
        port = where.port or (443 if where.scheme == "wss" else 80)
        link = socket.create_connection((where.hostname or "", port), _OPEN_S)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, _STUCK_US))
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            opening = connect(
                self._url,
                sock=link,
                additional_headers=self._headers,
                compression=None,  # pixels: deflate costs more than it saves
                open_timeout=_OPEN_S,
                ping_interval=None,  # a policy may compute on its event loop, and answers no ping meanwhile
                close_timeout=0,
                max_size=_MAX_BYTES,
            )
            return opening.__enter__()  # left by close_socket: __exit__ would wait for the other side
        except (WebSocketException, TimeoutError, ValueError) as error:
            link.close()
            raise Lost(f"no websocket there: {str(error) or type(error).__name__}") from error

    def send(self, data: bytes) -> None:
        """Raises Lost: the connection is closed, or the server reads nothing."""
        assert self._connection is not None, "open it first"
        try:
            self._connection.send(data)
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise Lost(f"connection lost: {error}") from error

    def recv(self, patience: Patience) -> bytes | str:
        """The next message. Raises PeerError: it does not come in time. Raises Lost: the connection is closed."""
        assert self._connection is not None, "open it first"
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    return self._connection.recv(timeout=patience.look_s())
        except PeerError:
            self.close()
            raise
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise Lost(f"connection lost: {error}") from error

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            _close(connection)


def _leave(opening: Future[ClientConnection]) -> None:
    """Closes a connection that came too late."""
    if opening.exception() is None:
        _close(opening.result())


def _close(connection: ClientConnection) -> None:
    with contextlib.suppress(Exception):  # it is of no use any more, whatever its end looks like
        connection.close_socket()
