"""Encodes and decodes large byte fields of protobuf messages without the library's four copies.

Protobuf's wire format allows a message's fields in any order, so a message with big blobs is written as ``tag
length bytes`` for each blob, followed by its small part as the library serializes it. Python's library would copy a
200 kB image into the message, into its parent, into the string, and again when decoding; joining by hand copies once,
splitting not at all. The blobs come first, so that a reader finds them without parsing the rest.
Format: protobuf.dev/programming-guides/encoding (field tag = number << 3 | wire type; 2 = length-delimited).
"""

from __future__ import annotations

from collections.abc import Iterable

Blob = tuple[bytes, "bytes | memoryview"]  # (the sub-message without its blob, the blob)

_LENGTH_DELIMITED = 2


def join(small: bytes, field: int, blob_field: int, blobs: Iterable[Blob]) -> bytes:
    """Joins one sub-message ``field`` per blob, which is its ``blob_field``, and ``small``. Field numbers < 16."""
    parts: list[bytes | memoryview] = []
    for meta, blob in blobs:
        blob_head = _head(blob_field, len(blob)) if len(blob) else b""
        size = len(blob_head) + len(blob) + len(meta)
        parts += (_head(field, size) + blob_head, blob, meta)
    parts.append(small)
    return b"".join(parts)


def split(payload: bytes, field: int, blob_field: int, *, most: int) -> tuple[bytes, list[tuple[bytes, memoryview]]]:
    """The inverse of ``join``: the bytes after the blobs, and each leading sub-message with its blob separated.

    Another encoder may put these fields elsewhere. They remain in the bytes, for protobuf to parse.

    Raises:
        ValueError: a leading blob is cut short, or there are more than ``most``.
    """
    view = memoryview(payload)
    tag, blob_tag = field << 3 | _LENGTH_DELIMITED, blob_field << 3 | _LENGTH_DELIMITED
    blobs: list[tuple[bytes, memoryview]] = []
    at = 0
    while at < len(payload) and payload[at] == tag:
        if len(blobs) == most:
            raise ValueError(f"more than {most} blobs")
        body, at = _extent(payload, at + 1, len(payload))
        if body < at and payload[body] == blob_tag:
            blob, end = _extent(payload, body + 1, at)
            blobs.append((payload[end:at], view[blob:end]))
        else:
            blobs.append((payload[body:at], view[:0]))
    return payload[at:], blobs


def _head(field: int, size: int) -> bytes:
    out = bytearray((field << 3 | _LENGTH_DELIMITED,))
    while size > 0x7F:
        out.append(size & 0x7F | 0x80)
        size >>= 7
    out.append(size)
    return bytes(out)


def _extent(payload: bytes, at: int, limit: int) -> tuple[int, int]:
    """Start and end of the bytes whose length prefix is at ``at``."""
    size = shift = 0
    while at < limit and shift < 70:
        byte = payload[at]
        at += 1
        size |= (byte & 0x7F) << shift
        if byte < 0x80:
            if at + size > limit:
                raise ValueError(f"bytes that begin at {at} end {at + size - limit} bytes past what holds them")
            return at, at + size
        shift += 7
    raise ValueError(f"length cut short at byte {at}")
