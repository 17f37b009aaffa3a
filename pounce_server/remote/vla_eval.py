"""vla-eval's model servers (0.8): numbered messages over a websocket, and an action for every observation."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from pounce_server.remote.openpi import ACTIONS
from pounce_server.remote.peer import Patience, PeerError
from pounce_server.remote.websocket import Socket
from protocol.peers.arrays import NotAMessage, pack, unpack
from protocol.peers.mapping import Key, PolicyMapping
from protocol.peers.translation import Values, nested

PROTOCOL_VERSION = 1
_MAX_ERROR = 500


class VlaEvalPeer:
    """A model server of ``vla-eval`` 0.8, whatever model it runs.

    Most of them keep a chunk for themselves and answer one row of it at a time; their next inference comes with the
    first observation after the last row. They are asked ``horizon`` times with one observation, so ``horizon`` must be
    their ``chunk_size``. One that answers with whole chunks (``chunk_size`` null) is asked once.
    """

    def __init__(self, url: str, mapping: PolicyMapping) -> None:
        """Raises ValueError: no websocket's address, or a mapping with a window."""
        if mapping.window is not None:
            raise ValueError(
                f"{mapping.name}: vla-eval's model servers read one observation, and keep their own history of those "
                "that they are asked with; leave [window] out"
            )
        self._socket, self._mapping = Socket(url, {}), mapping
        self._hello: Mapping[Any, Any] = {}
        self._seq = 0

    def facts(self, patience: Patience) -> str:
        self._connect(patience)
        names = ("model_server", "harness_version", "action_spec", "observation_spec")
        return ", ".join(f"{name}={self._hello[name]}" for name in names if name in self._hello)

    def begin(self, patience: Patience) -> None:
        """A new episode empties the server's buffer; a new connection is the surest way to no rows of the last one."""
        self.close()
        self._connect(patience)

    def infer(self, values: Values, patience: Patience) -> dict[Key, Any]:
        self._connect(patience)
        first = self._action(values, patience)
        if first.ndim != 1:
            return {ACTIONS: first}
        rows = [first] + [self._action(values, patience) for _ in range(self._mapping.horizon - 1)]
        if len({row.shape for row in rows}) > 1:
            self.close()
            raise PeerError(f"its rows have shapes {sorted({row.shape for row in rows})}")
        return {ACTIONS: np.stack(rows)}

    def close(self) -> None:
        self._socket.close()

    def _connect(self, patience: Patience) -> None:
        """Connects, compares versions and begins an episode. Raises PeerError."""
        if self._socket.is_open:
            return
        self._socket.open(patience)
        self._send("hello", {"harness_version": "0.8.0", "protocol_version": PROTOCOL_VERSION})
        hello = self._received("hello", patience)
        if (version := hello.get("protocol_version")) != PROTOCOL_VERSION:
            self.close()
            raise PeerError(f"it speaks protocol version {version!r}, expected {PROTOCOL_VERSION} (vla-eval 0.8)")
        self._hello = hello
        self._send("episode_start", {"task": {"name": self._mapping.name}, "mode": "sync"})

    def _action(self, values: Values, patience: Patience) -> np.ndarray[Any, Any]:
        self._send("observation", nested(values))
        actions = self._received("action", patience).get("actions")
        if actions is None:
            self.close()
            raise PeerError("expected actions, came none")
        return np.asarray(actions)

    def _send(self, kind: str, payload: Mapping[str, Any]) -> None:
        self._seq += 1
        message = {"type": kind, "payload": payload, "seq": self._seq, "timestamp": time.time_ns() / 1e9}
        self._socket.send(pack(message, "vla-eval"))

    def _received(self, expected: str, patience: Patience) -> Mapping[Any, Any]:
        packet = self._socket.recv(patience)
        try:
            message = unpack(packet) if isinstance(packet, bytes) else None
        except NotAMessage as error:
            self.close()
            raise PeerError(f"expected vla-eval's msgpack, came {error}") from None
        payload = message.get("payload") if isinstance(message, Mapping) else None
        if not isinstance(message, Mapping) or not isinstance(payload, Mapping):
            self.close()
            raise PeerError("expected a message with type and payload, as vla-eval 0.8 sends them")
        if message.get("type") == "error":
            self.close()
            raise PeerError(f"it says: {str(payload.get('error'))[:_MAX_ERROR]}")
        if message.get("type") != expected or message.get("seq") != self._seq:
            self.close()
            raise PeerError(
                f"expected the {expected} of message {self._seq}, came {str(message.get('type'))[:80]} of "
                f"{message.get('seq')}"
            )
        return payload
