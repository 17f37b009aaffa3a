"""Large byte fields enter and leave protobuf without being copied four times.

Protobuf's wire format lets a message's fields stand in any order, so a message with big blobs is its small part, as the
library serializes it, followed by ``tag length bytes`` for each blob. Python's library would copy a 200 kB image into
the message, into its parent, into the string, and again on the way out; joining by hand copies once, splitting not at
all. Format: protobuf.dev/programming-guides/encoding (field tag = number << 3 | wire type; 2 = length-delimited).
"""

from __future__ import annotations

from collections.abc import Iterable

Blob = tuple[bytes, "bytes | memoryview"]  # (the sub-message without its blob, the blob)

_LENGTH_DELIMITED = 2
_FIXED_SIZES = {1: 8, 5: 4}  # wire type -> bytes


def join(small: bytes, field: int, blob_field: int, blobs: Iterable[Blob]) -> bytes:
    """``small`` plus one sub-message ``field`` per blob, whose ``blob_field`` holds the blob."""
    parts: list[bytes | memoryview] = [small]
    for meta, blob in blobs:
        blob_head = _varint(blob_field << 3 | _LENGTH_DELIMITED) + _varint(len(blob)) if len(blob) else b""
        size = len(meta) + len(blob_head) + len(blob)
        parts += [_varint(field << 3 | _LENGTH_DELIMITED) + _varint(size) + meta + blob_head, blob]
    return b"".join(parts)


def split(payload: bytes, field: int, blob_field: int) -> tuple[bytes, list[tuple[bytes, memoryview]]]:
    """The inverse of ``join``, for any order of fields: the small part, and each sub-message with its blob apart.

    Raises:
        ValueError: the bytes are cut short or use a wire type that proto3 does not know.
    """
    small, found = _take(memoryview(payload), field)
    blobs = []
    for sub in found:
        meta, data = _take(sub, blob_field)
        blobs.append((meta, data[-1] if data else memoryview(b"")))  # proto3: the last one wins
    return small, blobs


def _take(view: memoryview, field: int) -> tuple[bytes, list[memoryview]]:
    rest: list[memoryview] = []
    taken: list[memoryview] = []
    at = 0
    while at < len(view):
        start = at
        tag, at = _read_varint(view, at)
        wire = tag & 7
        if wire == 0:
            _, at = _read_varint(view, at)
        elif wire in _FIXED_SIZES:
            at += _FIXED_SIZES[wire]
        elif wire == _LENGTH_DELIMITED:
            size, at = _read_varint(view, at)
            body, at = at, at + size
            if at <= len(view) and tag >> 3 == field:
                taken.append(view[body:at])
                continue
        else:
            raise ValueError(f"wire type {wire} at byte {start}")
        if at > len(view):
            raise ValueError(f"field {tag >> 3} at byte {start} ends {at - len(view)} bytes past the message")
        rest.append(view[start:at])
    return b"".join(rest), taken


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read_varint(view: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(view) and shift < 70:
        byte = view[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError(f"varint cut short at byte {at}")
