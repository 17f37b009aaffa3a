"""The conversation with ``pp-gateway --dialect openpi``: msgpack maps with arrays over a websocket."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


class Refused(Exception):
    """The gateway does not take a request, or is not there, and says why."""


class Policy:
    """One connection. An answer may take ``patience_s``: in lockstep models take their time."""

    def __init__(self, url: str, api_key: str = "", patience_s: float = 300.0) -> None:
        """Raises Refused if nobody answers there."""
        options: dict[str, Any] = {"compression": None, "max_size": None, "open_timeout": 10.0}
        if "proxy" in inspect.signature(connect).parameters:
            options["proxy"] = None
        if api_key:
            options["additional_headers"] = {"Authorization": "Api-Key " + api_key}
        self._url, self._patience_s = url, patience_s
        try:
            self._socket = connect(url, **options)
        except (OSError, TimeoutError, EOFError, ConnectionClosed, InvalidStatus) as error:
            raise Refused(f"{url}: expected pp-gateway --dialect openpi, came {error}") from None
        self.metadata: dict[str, Any] = self._receive()

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to an observation. Raises Refused."""
        return self._ask(observation)

    def reset(self) -> None:
        """Ends the episode, so that the same instruction begins another one."""
        self._ask({"reset": True})

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Policy:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        try:
            self._socket.send(msgpack.packb(dict(message), default=_spelled))
        except ConnectionClosed as error:
            raise Refused(f"{self._url} left: {error}") from None
        return self._receive()

    def _receive(self) -> dict[str, Any]:
        try:
            packet = self._socket.recv(timeout=self._patience_s)
        except TimeoutError:
            raise Refused(f"{self._url}: no answer within {self._patience_s:g} s") from None
        except ConnectionClosed as error:
            raise Refused(f"{self._url} left: {error}") from None
        if isinstance(packet, str):  # openpi's form of an error
            raise Refused(packet)
        answer = msgpack.unpackb(packet, object_hook=_read)
        if not isinstance(answer, dict):
            raise Refused(f"{self._url}: expected a map, came {type(answer).__name__}")
        return answer


def _spelled(item: Any) -> Any:
    if isinstance(item, np.generic):
        return item.item()
    if isinstance(item, np.ndarray):
        array = np.ascontiguousarray(item)
        return {
            b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": list(array.shape),
        }  # fmt: skip
    raise TypeError(f"{type(item).__name__} has no place in a message")


def _read(item: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in item:
        return item
    return np.frombuffer(item[b"data"], np.dtype(item[b"dtype"])).reshape(item[b"shape"])
