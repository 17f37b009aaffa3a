"""openpi's websocket, which SGLang and vLLM-Omni speak too: metadata, then one observation, one answer."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np

from pounce_server.remote.peer import Lost, Patience, PeerError
from pounce_server.remote.websocket import Socket
from protocol.peers.arrays import NotAMessage, pack, unpack
from protocol.peers.mapping import Key, PolicyMapping
from protocol.peers.translation import Values, nested, picked

ACTIONS = ("actions",)
_SESSION = "session_id"
_MAX_ERROR = 500


class OpenpiPeer:
    """A server of ``openpi``, of vLLM-Omni (``/v1/realtime/robot/openpi``) or of SGLang (``/openpi/policy``).

    openpi's own has no episodes. Servers that ask for a session id (vLLM-Omni's stateful policies) get a new one with
    each episode. An answer is a map with ``actions``, an array alone, or a map with an array for each key.
    """

    def __init__(self, url: str, mapping: PolicyMapping, api_key: str = "") -> None:
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        self._socket, self._mapping = Socket(url, headers), mapping
        self._metadata: dict[Any, Any] | None = None
        self._session = secrets.token_hex(8)

    def facts(self, patience: Patience) -> str:
        self._connect(patience)
        return ", ".join(f"{key}={value}" for key, value in sorted((self._metadata or {}).items())) or "nothing"

    def begin(self, patience: Patience) -> None:
        self._session = secrets.token_hex(8)
        self._connect(patience)

    def infer(self, values: Values, patience: Patience) -> dict[Key, Any]:
        was_open = self._socket.is_open
        try:
            return self._asked(values, patience)
        except Lost:
            if not was_open:
                raise
        return self._asked(values, patience)  # it was closed while nobody looked: vLLM-Omni's after 30 idle seconds

    def close(self) -> None:
        self._socket.close()

    def _connect(self, patience: Patience) -> None:
        """Raises PeerError: no server, or another one than at first."""
        if self._socket.is_open:
            return
        self._socket.open(patience)
        metadata = self._received(patience)
        if not isinstance(metadata, dict) or metadata.get("type") == "error":
            self.close()
            raise PeerError(f"expected a map of metadata at first, came {str(metadata)[:_MAX_ERROR]!r}")
        if self._metadata is not None and metadata != self._metadata:
            self.close()
            raise PeerError(
                "it says other things of itself than when pounce-serve compared it with the mapping file; start "
                "pounce-serve again"
            )
        self._metadata = metadata

    def _asked(self, values: Values, patience: Patience) -> dict[Key, Any]:
        self._connect(patience)
        message = nested(values)
        if self._metadata and self._metadata.get("needs_session_id"):
            message[_SESSION] = self._session
        self._socket.send(pack(message, "openpi"))
        return self._arrays(self._received(patience))

    def _received(self, patience: Patience) -> Any:
        packet = self._socket.recv(patience)
        if isinstance(packet, str):  # a traceback, its cause last
            self.close()
            raise PeerError(f"it says: {packet.strip()[-_MAX_ERROR:]}")
        try:
            return unpack(packet)
        except NotAMessage as error:
            self.close()
            raise PeerError(f"expected openpi's msgpack, came {error}") from None

    def _arrays(self, answer: Any) -> dict[Key, Any]:
        if isinstance(answer, np.ndarray):
            return {ACTIONS: answer}
        if not isinstance(answer, Mapping):
            raise PeerError(f"expected actions, came {type(answer).__name__}")
        if answer.get("type") == "error":
            raise PeerError(f"it says: {str(answer.get('message', answer))[:_MAX_ERROR]}")
        actions = answer.get("actions")
        if isinstance(actions, Mapping):
            return {(str(name),): array for name, array in actions.items()}
        if actions is not None:
            return {ACTIONS: actions}
        found = picked(answer, list(self._mapping.action_keys()))
        return found or {(str(name),): value for name, value in answer.items() if isinstance(value, np.ndarray)}
