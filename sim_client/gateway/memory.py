"""Memory for requests, over all connections together: when it runs out, the client that holds most of it loses."""

from __future__ import annotations

import threading
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode


class Memory:
    """Bytes that clients may have under way, read and not yet answered.

    Args:
        limit: in bytes.
    """

    def __init__(self, limit: int = 2 << 30) -> None:
        self.limit = limit
        self._held: dict[object, int] = {}
        self._lock = threading.Lock()

    def take(self, holder: object, count: int) -> object | None:
        """Adds bytes to what ``holder`` has; returns the holder of most if all together have too much, else None."""
        with self._lock:
            self._held[holder] = self._held.get(holder, 0) + count
            return max(self._held, key=self._held.__getitem__) if sum(self._held.values()) > self.limit else None

    def give(self, holder: object, count: int | None = None) -> None:
        """Takes ``count`` of its bytes off again; None: all."""
        with self._lock:
            left = 0 if count is None else self._held.get(holder, 0) - count
            if left > 0:
                self._held[holder] = left
            else:
                self._held.pop(holder, None)

    @property
    def sentence(self) -> str:
        return f"the requests of all clients are more than {self.limit >> 20} MB: see --max-memory-mb"


class CountedConnection(ServerConnection):  # type: ignore[misc]  # untyped
    """A websocket whose received bytes are counted, from their arrival until the next message is asked for.

    The conversation asks for the next message when it has answered the last one.
    """

    memory: Memory  # of its subclass, one for all connections of a server

    def data_received(self, data: bytes) -> None:
        most = self.memory.take(self, len(data))
        if isinstance(most, CountedConnection):
            most.refuse()
        super().data_received(data)

    def refuse(self) -> None:
        """Closes it with a sentence; what it has sent is forgotten."""
        self.memory.give(self)
        self.protocol.fail(CloseCode.MESSAGE_TOO_BIG, self.memory.sentence)
        super().data_received(b"")  # sends what `fail` says

    async def recv(self, *args: Any, **options: Any) -> Any:
        self.memory.give(self, self._answered)
        message = await super().recv(*args, **options)
        self._answered = len(message)
        return message

    def connection_lost(self, exc: Exception | None) -> None:
        self.memory.give(self)
        super().connection_lost(exc)

    _answered = 0


def counted(memory: Memory) -> type[CountedConnection]:
    """The class of connections that share ``memory``."""
    return type("Connection", (CountedConnection,), {"memory": memory})
