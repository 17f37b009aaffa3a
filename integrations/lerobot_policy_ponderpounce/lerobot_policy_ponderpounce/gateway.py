"""A client of pp-gateway's dialect ``openpi``: an observation out, rows of commands in."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect


class Client:
    """One connection, which is one robot's seat at the gateway."""

    def __init__(self, url: str, answer_s: float) -> None:
        """Raises ConnectionError: nobody answers there."""
        self._url, self._answer_s = url, answer_s
        try:
            self._socket = connect(url, compression=None, max_size=None, ping_timeout=None)
            self.metadata = self._received()
        except (OSError, WebSocketException) as error:
            raise ConnectionError(f"{url}: {error}; expected pp-gateway --dialect openpi") from error
        self._has_begun = False

    def infer(self, observation: dict[str, Any]) -> np.ndarray:
        """The rows, (rows, action) float32.

        Raises:
            RuntimeError: the gateway refuses; its sentence says why.
            ConnectionError: it is gone, or says nothing in time.
        """
        self._has_begun = True
        answer = self._asked(observation)
        return np.asarray(answer["actions"], np.float32)

    def reset(self) -> None:
        """Ends the episode, if one was begun. Raises as ``infer``."""
        if self._has_begun:
            self._asked({"reset": True})
            self._has_begun = False

    def close(self) -> None:
        self._socket.close()

    def _asked(self, message: dict[str, Any]) -> Any:
        try:
            self._socket.send(msgpack.packb(message, default=_spelled))
            return self._received()
        except (OSError, WebSocketException) as error:
            raise ConnectionError(f"{self._url}: {error or 'no answer in time'}") from error

    def _received(self) -> Any:
        answer = self._socket.recv(self._answer_s)
        if isinstance(answer, str):
            raise RuntimeError(f"pp-gateway refuses: {answer}")
        return msgpack.unpackb(answer, object_hook=_read, strict_map_key=False)


def _spelled(array: Any) -> dict[bytes, Any]:
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{type(array).__name__} has no place in a message")
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}


def _read(item: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in item:
        return item
    return np.frombuffer(item[b"data"], np.dtype(item[b"dtype"])).reshape(item[b"shape"])
