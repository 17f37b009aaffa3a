"""The records of an MCAP file from anywhere, up to its end or its first damage, within limits on what they unpack to.

A chunk says itself what it unpacks to, and a few bytes of it can be gigabytes. So sizes are looked at before a byte is
unpacked, and a file may hold more than any log of an episode only in proportion to its own size.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader

MAX_RECORD_BYTES = 64 << 20  # a larger length is damaged: a chunk of ours has 1 MiB, or a second of raw frames
MAX_UNPACKED_BYTES = 1 << 30  # of all chunks, and 16 times the file: an episode's raw frames at 8 MB/s have 520 MB
MAX_MESSAGES = 300_000  # and one for 100 bytes of the file: an hour at 20 Hz with cameras has 600,000 in 700 MB

_UNKNOWN = ("", "")
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class TooLarge(ValueError):
    """A file that holds more than any log of an episode; what and where."""


class Records:
    """An iterator over the records; chunks are unpacked, and what they hold comes one by one.

    Iterating raises TooLarge for a file that unpacks to more than any log of an episode.

    Attributes:
        num_bytes: size of the file.
        damage: where and why the file could not be read on; "" if it was whole.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.damage = ""
        self.num_bytes = os.fstat(file.fileno()).st_size
        self._file = file
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}
        self._bytes_left = MAX_UNPACKED_BYTES + 16 * self.num_bytes
        self._messages_left = MAX_MESSAGES + self.num_bytes // 100
        self._records = self._flat()

    def __iter__(self) -> Iterator[Any]:
        while True:
            try:
                record = next(self._records)
            except StopIteration:
                return
            except TooLarge:
                raise
            except Exception as error:  # on damaged files the library raises many types, even OverflowError
                self.damage = f"unfinished or damaged near byte {self._file.tell()}: {type(error).__name__} {error}"
                return
            if isinstance(record, Schema):
                self._schemas[record.id] = record.name
            elif isinstance(record, Channel):
                self._channels[record.id] = (self._schemas.get(record.schema_id, ""), record.topic)
            elif isinstance(record, Message):
                self._messages_left -= 1
                if self._messages_left < 0:
                    raise TooLarge(f"more than {MAX_MESSAGES} messages in {self.num_bytes} bytes")
            yield record

    @staticmethod
    def is_message(record: Any) -> bool:
        """Whether a record is a message: for those who do without the library's classes."""
        return isinstance(record, Message)

    def schema_of(self, message: Message) -> str:
        """Name of a message's schema; "" if it has none."""
        return self._channels.get(message.channel_id, _UNKNOWN)[0]

    def topic_of(self, message: Message) -> str:
        """A message's topic; "" if its channel is not described."""
        return self._channels.get(message.channel_id, _UNKNOWN)[1]

    def _flat(self) -> Iterator[Any]:
        reader = StreamReader(self._file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from _records_in(self._unpacked(record))
            else:
                yield record

    def _unpacked(self, chunk: Chunk) -> bytes:
        size = chunk.uncompressed_size
        self._bytes_left -= size
        if size > MAX_RECORD_BYTES or self._bytes_left < 0:
            most = f"at most {MAX_RECORD_BYTES >> 20} MiB a chunk and {MAX_UNPACKED_BYTES >> 20} MiB in all"
            raise TooLarge(f"its chunk near byte {self._file.tell()} unpacks to {size} bytes; expected {most}")
        data = _decompressed(chunk)
        if len(data) != size:
            raise ValueError(f"a chunk of {size} bytes unpacks to {'more' if len(data) > size else len(data)}")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("a chunk's checksum does not fit")
        return data


def _decompressed(chunk: Chunk) -> bytes:
    """At most one byte more than the chunk claims; a zstd frame, which is believed, has to claim the same."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        if (claimed := zstandard.frame_content_size(chunk.data)) not in (-1, size):
            raise ValueError(f"a chunk of {size} bytes holds a frame of {claimed}")
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES)
        return unpacker.decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    if chunk.compression:
        raise ValueError(f"compression {chunk.compression!r}: expected zstd, lz4 or none")
    return bytes(chunk.data)


def _records_in(data: bytes) -> Iterator[Any]:
    """Schemas, channels and messages; one at a time, because a megabyte can hold thirty thousand."""
    at = 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if at > len(data):
            raise ValueError("a record ends beyond its chunk")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            yield Message(channel, log_time, data[start + _MESSAGE.size : at], publish_time, sequence)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(io.BytesIO(data[start:at])))
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(io.BytesIO(data[start:at])))
