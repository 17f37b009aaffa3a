"""LeRobot's remote inference on the wire, version 1: keys, envelopes of MessagePack, and what its codec allows.

Written from its public sources of October 2026, none of which is a release: see docs/lerobot.md. Both sides use it:
`pounce-serve --backend lerobot` is a client of that wire, `pp-gateway --dialect lerobot` a server.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from protocol import images
from protocol.errors import MalformedMessage, ProtocolError
from protocol.messages import Image, ImageCodec

VERSION = 1
MAX_MESSAGE_BYTES = 32 << 20
_MAX_DECODED_BYTES = 64 << 20
_MAX_ARRAY_BYTES = 32 << 20
_MAX_SIDE, _MAX_RANK, _MAX_PIXELS = 16_384, 8, 4096 * 4096
_MAX_TEXT_BYTES, _MAX_ITEMS, _MAX_NODES, _MAX_DEPTH = 16_384, 4096, 32_768, 16
CODEC_LIMITS = {
    "max_payload_bytes": MAX_MESSAGE_BYTES, "max_decoded_bytes": _MAX_DECODED_BYTES,
    "max_tensor_bytes": _MAX_ARRAY_BYTES, "max_image_pixels": _MAX_PIXELS, "max_dimension": _MAX_SIDE,
    "max_rank": _MAX_RANK, "max_string_bytes": _MAX_TEXT_BYTES, "max_container_items": _MAX_ITEMS,
    "max_nodes": _MAX_NODES, "max_depth": _MAX_DEPTH,
}  # fmt: skip
"""As a server tells them to its clients."""

_TYPE = "__lerobot_type__"
_DTYPE = re.compile(r"u?int(?:8|16|32|64)|float(?:16|32|64)|bool")
_SEGMENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}")
_KINDS = {
    "describe", "descriptor", "open", "accepted", "control", "ack", "observation", "action", "language_request",
    "language_result", "error",
}  # fmt: skip
_OF_A_SESSION = {"control", "ack", "observation", "action", "language_request", "language_result"}
_HEADER = ("version", "message_type", "instance_id", "session_id", "generation", "request_id", "body")
_MAX_MESSAGE_CHARS = 2048


class Code(StrEnum):
    """Why a request gets an error."""

    UNSUPPORTED = "unsupported"
    MALFORMED = "malformed"
    BUSY = "busy"
    STALE = "stale"
    INCOMPATIBLE = "incompatible"
    EXECUTION = "execution"
    TIMEOUT = "timeout"
    PROTOCOL = "protocol"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Envelope:
    """One message. Ids are "" where they are not known yet; a reply has those of its request."""

    kind: str
    body: Mapping[str, Any] = field(default_factory=dict)
    instance_id: str = ""
    session_id: str = ""
    request_id: str = ""
    generation: int = 0

    def reply(self, kind: str, body: Mapping[str, Any]) -> Envelope:
        return replace(self, kind=kind, body=body)

    def error(self, error: WireError) -> Envelope:
        details = {} if error.details is None else {"details": error.details}
        return self.reply("error", {"code": str(error.code), "message": str(error)[:_MAX_MESSAGE_CHARS], **details})


class WireError(ProtocolError):
    """What a request gets instead of an answer. ``asked``: its envelope without the body, as far as it was read."""

    def __init__(self, code: Code, sentence: str, details: Mapping[str, Any] | None = None) -> None:
        super().__init__(sentence)
        self.code = code
        self.details = details
        self.asked: Envelope | None = None


def is_name(value: Any) -> bool:
    """Whether it can name a deployment, an instance, a session or a request."""
    return isinstance(value, str) and _SEGMENT.fullmatch(value) is not None


def deployment_key(deployment: str) -> str:
    return f"lerobot/inference/v{VERSION}/deployments/{deployment}"


def instance_key(deployment: str, instance_id: str) -> str:
    return f"{deployment_key(deployment)}/instances/{instance_id}"


def session_key(deployment: str, instance_id: str, session_id: str) -> str:
    return f"{instance_key(deployment, instance_id)}/sessions/{session_id}"


def pack(envelope: Envelope) -> bytes:
    """An envelope as LeRobot reads it; uint8 arrays of three dimensions are pictures. Its reader takes no empty array.

    Raises:
        TypeError: a value that has no place in this wire.
    """
    values = (
        VERSION, envelope.kind, envelope.instance_id, envelope.session_id, envelope.generation, envelope.request_id,
        envelope.body,
    )  # fmt: skip
    return bytes(msgpack.packb(dict(zip(_HEADER, values, strict=True)), default=_spelled))


def unpack(packet: bytes) -> Envelope:
    """The envelope in a packet; arrays are read-only, pictures (height, width, 3) uint8 RGB.

    Raises:
        WireError: not of this wire, or beyond its limits; with the envelope's ids, if these could be read.
    """
    if len(packet) > MAX_MESSAGE_BYTES:
        raise _malformed(f"a message of {len(packet)} bytes; expected at most {MAX_MESSAGE_BYTES}")
    record = _parsed(packet)
    if not isinstance(record, dict) or (missing := [name for name in _HEADER if name not in record]):
        came = f"a map without {', '.join(missing)}" if isinstance(record, dict) else type(record).__name__
        raise _malformed(f"expected a map with {', '.join(_HEADER)}, came {came}")
    head = _head(record)
    try:
        body = _Reader().value(record["body"], 1)
        if not isinstance(body, dict):
            raise _malformed(f"body: expected a map, came {type(body).__name__}")
    except WireError as error:
        error.asked = head
        raise
    return replace(head, body=body)


def _head(record: Mapping[str, Any]) -> Envelope:
    if type(record["version"]) is not int or record["version"] != VERSION:
        raise WireError(Code.PROTOCOL, f"version {str(record['version'])[:80]!r}: expected {VERSION}")
    kind, generation = record["message_type"], record["generation"]
    if not isinstance(kind, str) or kind not in _KINDS:
        raise _malformed(f"message_type {str(kind)[:80]!r}: expected one of {', '.join(sorted(_KINDS))}")
    if type(generation) is not int or not 0 <= generation < 1 << 63:
        raise _malformed(f"generation {str(generation)[:80]!r}: expected a whole number from 0 on")
    ids = {name: record[name] for name in ("instance_id", "session_id", "request_id")}
    for name, value in ids.items():
        if value != "" and not is_name(value):
            raise _malformed(f"{name} {str(value)[:80]!r}: expected at most 128 of A-Z a-z 0-9 _ . -")
        if not value and kind in _OF_A_SESSION:
            raise _malformed(f"{kind} without {name}")
    return Envelope(kind=kind, generation=generation, **ids)


def _malformed(sentence: str) -> WireError:
    return WireError(Code.MALFORMED, sentence)


def _parsed(packet: bytes) -> Any:
    """The packet's values, before arrays. Counted while they are read: a few bytes can hold thousands of brackets."""
    left = _MAX_NODES

    def counted(number: int) -> None:
        nonlocal left
        left -= number
        if left < 0:
            raise _malformed(f"more than {_MAX_NODES} values: send arrays, not lists")

    def mapped(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
        counted(len(pairs))
        found = dict(pairs)
        if len(found) != len(pairs) or not all(isinstance(name, str) for name in found):
            raise _malformed("a map with a key twice, or with a key that is no text")
        return found

    def listed(items: list[Any]) -> list[Any]:
        counted(len(items))
        return items

    try:
        return msgpack.unpackb(
            packet,
            object_pairs_hook=mapped,
            list_hook=listed,
            max_str_len=_MAX_TEXT_BYTES,
            max_bin_len=MAX_MESSAGE_BYTES,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        why = str(error) or type(error).__name__
        raise _malformed(f"{len(packet)} bytes that are no message of this wire: {why}") from None


class _Reader:
    """Values of one message; it counts the bytes that arrays and pictures take."""

    def __init__(self) -> None:
        self._left = _MAX_DECODED_BYTES

    def value(self, value: Any, depth: int) -> Any:
        if depth > _MAX_DEPTH:
            raise _malformed(f"maps and lists more than {_MAX_DEPTH} deep")
        if isinstance(value, dict):
            if _TYPE in value:
                return self._array(value)
            return {name: self.value(each, depth + 1) for name, each in value.items()}
        if isinstance(value, list):
            return [self.value(each, depth + 1) for each in value]
        if isinstance(value, float) and not math.isfinite(value):
            raise _malformed(f"expected finite numbers, came {value}")
        if value is None or isinstance(value, str | bytes | bool | int | float):
            return value
        raise _malformed(f"{type(value).__name__} has no place in this wire")  # msgpack's own instants

    def _array(self, item: Mapping[str, Any]) -> NDArray[Any]:
        kind, data = item[_TYPE], item.get("data")
        if kind not in ("tensor", "rgb") or not isinstance(data, bytes):
            raise _malformed(f"an array of kind {str(kind)[:80]!r}: expected tensor or rgb, and bytes in data")
        shape = _shape(item.get("shape"))
        return self._picture(item, shape, data) if kind == "rgb" else self._tensor(item, shape, data)

    def _tensor(self, item: Mapping[str, Any], shape: tuple[int, ...], data: bytes) -> NDArray[Any]:
        name, order = item.get("dtype"), item.get("endianness")
        if not isinstance(name, str) or not _DTYPE.fullmatch(name) or order not in ("little", "big"):
            raise _malformed(f"a tensor of {str(name)[:80]!r}, {str(order)[:80]!r}: expected numbers, little or big")
        dtype = np.dtype(name).newbyteorder("<" if order == "little" else ">")
        self._take(math.prod(shape) * dtype.itemsize, len(data), shape, _MAX_ARRAY_BYTES)
        if dtype.kind == "b" and data.translate(None, b"\0\1"):
            raise _malformed("a tensor of bool: expected bytes 0 and 1")
        array = np.frombuffer(data, dtype).reshape(shape)
        if dtype.kind == "f" and not np.isfinite(array).all():
            raise _malformed(f"a tensor {shape}: expected finite numbers")
        return array.astype(dtype.newbyteorder("="), copy=False)

    def _picture(self, item: Mapping[str, Any], shape: tuple[int, ...], data: bytes) -> NDArray[np.uint8]:
        if len(shape) != 3 or shape[2] != 3 or math.prod(shape[:2]) > _MAX_PIXELS:
            raise _malformed(f"a picture {shape}: expected (height, width, 3), at most {_MAX_PIXELS} px")
        if item.get("dtype") != "uint8" or item.get("channel_order") != "RGB":
            raise _malformed("a picture: expected uint8 and RGB")
        encoding = item.get("encoding")
        if encoding == "raw":
            self._take(math.prod(shape), len(data), shape, _MAX_DECODED_BYTES)
            return np.frombuffer(data, np.uint8).reshape(shape)
        if encoding != "jpeg":
            raise _malformed(f"a picture in {str(encoding)[:80]!r}: expected raw or jpeg")
        self._take(math.prod(shape), math.prod(shape), shape, _MAX_DECODED_BYTES)
        height, width, _ = shape
        try:
            return images.unpack(Image(camera="", codec=ImageCodec.JPEG, height=height, width=width, data=data))
        except MalformedMessage as error:
            raise _malformed(f"a picture in jpeg: {error}") from None

    def _take(self, num_bytes: int, came: int, shape: tuple[int, ...], most: int) -> None:
        if came != num_bytes:
            raise _malformed(f"an array {shape}: expected {num_bytes} bytes, {came} came")
        self._left -= num_bytes
        if num_bytes > most or self._left < 0:
            raise _malformed(f"an array {shape} of {num_bytes} bytes: more than a message may hold")


def _shape(shape: Any) -> tuple[int, ...]:
    is_shape = isinstance(shape, list) and len(shape) <= _MAX_RANK
    if not is_shape or not all(type(side) is int and 0 < side <= _MAX_SIDE for side in shape):
        raise _malformed(f"an array of shape {str(shape)[:80]}: expected at most {_MAX_RANK} sides, 1 to {_MAX_SIDE}")
    return tuple(shape)


def _spelled(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray) or not _DTYPE.fullmatch(value.dtype.name):
        raise TypeError(f"{type(value).__name__} has no place in this wire")
    array = np.ascontiguousarray(value).reshape(value.shape)
    item = {"dtype": array.dtype.name, "shape": list(array.shape), "data": array.tobytes()}
    if array.dtype == np.uint8 and array.ndim == 3:
        return {_TYPE: "rgb", "encoding": "raw", "channel_order": "RGB", **item}
    return {_TYPE: "tensor", "endianness": "big" if array.dtype.str.startswith(">") else "little", **item}
