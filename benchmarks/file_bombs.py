"""What does a file cost that claims more than it is? Small files that unpack to gigabytes, given to the commands.

python -m benchmarks.file_bombs
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import simplejpeg
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from benchmarks.report import Report, Row
from protocol import codec
from protocol import messages as m

GIGABYTE = 1 << 30


@dataclass(frozen=True)
class Options:
    """None."""


@dataclass(frozen=True, slots=True)
class Bomb:
    """A file, the limit that it meets, and the command that is given it."""

    name: str
    limit: str
    make: Callable[[Path], None]
    command: Sequence[str]  # FILE and FOLDER are replaced


def _log(path: Path, messages: Sequence[tuple[type, bytes]], times: int, compression: CompressionType) -> None:
    """A log of the same messages many times over, with an EpisodeInfo first."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 20, compression=compression, enable_crcs=False)
        writer.start()
        channels = {}
        for cls in dict.fromkeys([m.EpisodeInfo, *(cls for cls, _ in messages)]):
            name = codec.type_name(cls) if cls.__module__ == m.__name__ else cls.DESCRIPTOR.full_name  # type: ignore[attr-defined]
            channels[cls] = writer.register_channel(
                f"/{cls.__name__}", "protobuf", writer.register_schema(name, "protobuf", b"")
            )
        writer.add_message(channels[m.EpisodeInfo], 1, codec.encode(_info()), 1)
        for _ in range(times):
            for cls, payload in messages:
                writer.add_message(channels[cls], 1, payload, 1)
        writer.finish()


def _info() -> m.EpisodeInfo:
    from clock import schedules

    zeros = np.zeros(2, np.float32)
    robot = m.Robot(name="arm", command_low=zeros - 1, command_high=zeros + 1, max_step=zeros, initial_command=zeros,
                    cameras=("front",), image_height=16, image_width=16, num_proprio=2, is_simulated=True)  # fmt: skip
    header = m.Header(robot="arm", session="s", episode="e", epoch=1, proc="sim")
    return m.EpisodeInfo(header=header, task="PickHighlight", suite="", seed=0, difficulty="easy", instruction="",
                         schedule=schedules.paper(), robot=robot, t0_unix_ns=1)  # fmt: skip


_HEADER = m.Header(robot="arm", session="s", episode="e", epoch=1, proc="clock")


def _one_chunk(path: Path) -> None:
    """One chunk of five gigabytes of zeros."""
    import zstandard

    packer = zstandard.ZstdCompressor(level=3).compressobj()
    zeros = bytes(64 << 20)
    packed = b"".join([packer.compress(zeros) for _ in range(80)] + [packer.flush()])
    _with_chunk(path, packed, 80 * len(zeros), "zstd")


def _lying_chunk(path: Path) -> None:
    """A chunk that claims a kilobyte, and whose frame claims 16 GB."""
    import zstandard

    frame = bytearray(zstandard.ZstdCompressor().compress(bytes(1 << 20)))
    frame[4:14] = b"\xe0" + (16 * GIGABYTE).to_bytes(8, "little") + b"\0"
    _with_chunk(path, bytes(frame), 1000, "zstd")


def _with_chunk(path: Path, packed: bytes, size: int, compression: str) -> None:
    _log(path, [], 0, CompressionType.NONE)
    whole = path.read_bytes()
    chunk = Chunk(compression=compression, data=packed, message_end_time=1, message_start_time=1, uncompressed_crc=0,
                  uncompressed_size=size)  # fmt: skip
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    chunk.write(builder)
    (first,) = [r for r in StreamReader(io.BytesIO(whole), emit_chunks=True).records if isinstance(r, Chunk)][:1]
    at = whole.index(first.data) + len(first.data)
    path.write_bytes(whole[:at] + builder.end() + whole[at:])


def _many_chunks(path: Path) -> None:
    """Four thousand chunks of a megabyte of something that nobody reads."""
    _log(path, [(CompressedImage, bytes(1 << 20))], 4_000, CompressionType.ZSTD)


def _many_messages(path: Path) -> None:
    _log(path, [(CompressedImage, b"")], 2_000_000, CompressionType.ZSTD)


def _many_ticks(path: Path) -> None:
    tick = m.Tick(header=_HEADER, tick=0, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.HOLD)
    _log(path, [(m.Tick, codec.encode(tick))], 200_000, CompressionType.LZ4)


def _large_mappings(path: Path) -> None:
    event = m.Event(
        header=_HEADER, severity=m.Severity.INFO, name="x", text="", attributes={f"{i}": "" for i in range(256)}
    )
    _log(path, [(m.Event, codec.encode(event))], 20_000, CompressionType.ZSTD)


def _one_message(path: Path) -> None:
    """An observation of sixteen million pictures of no bytes."""
    _log(path, [(m.Observation, b"\x2a\x00" * (16 << 20))], 1, CompressionType.ZSTD)


def _ticks_and_chunks(path: Path) -> None:
    """What a careless check compares each with each."""
    tick = m.Tick(header=_HEADER, tick=0, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.HOLD)
    stamp = m.Stamp(header=_HEADER, kind=m.StampKind.CHUNK, index=0, source_ns=0, ready_ns=0, arrived_ns=0)
    _log(path, [(m.Tick, codec.encode(tick)), (m.Stamp, codec.encode(stamp))], 25_000, CompressionType.ZSTD)


def _picture(path: Path, data: bytes) -> None:
    picture = CompressedImage(frame_id="front", format="jpeg", data=data)
    _log(path, [(CompressedImage, picture.SerializeToString())], 1, CompressionType.ZSTD)


def _jpeg_header(path: Path) -> None:
    data = bytearray(simplejpeg.encode_jpeg(np.zeros((16, 16, 3), np.uint8), colorspace="RGB"))
    at = data.find(b"\xff\xc0")
    data[at + 5 : at + 9] = b"\xff\xdc\xff\xdc"
    _picture(path, bytes(data))


def _png_header(path: Path) -> None:
    head = b"IHDR" + (65_000).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0"
    _picture(path, b"\x89PNG\r\n\x1a\n\0\0\0\r" + head + zlib.crc32(head).to_bytes(4, "big"))


def _npz(path: Path) -> None:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": (GIGABYTE,)})
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed,
        packed.open("inner.npy", "w", force_zip64=True) as to,
    ):
        to.write(head.getvalue())
        for _ in range(64):
            to.write(bytes(64 << 20))


def _json(path: Path) -> None:
    path.write_bytes(b"[" * (200 << 20))


CHECK = ("pp-check", "FILE")
SHOW = ("pp-replay", "FILE", "--save", "FOLDER/x.rrd")
RECOVER = ("pp-check", "--recover", "FOLDER/new.mcap", "FILE")
HEAD = ("pp-check", "--residual-head", "FILE", "FILE")
TABLES = ("pp-tables", "FILE", "--out", "FOLDER/out")
_KEPT = "64 MiB + 16 x file in memory"
BOMBS = (
    Bomb("log: one chunk of 5 GB", "64 MiB a chunk", _one_chunk, CHECK),
    Bomb("the same, recovered", "64 MiB a chunk", _one_chunk, RECOVER),
    Bomb("the same, shown", "64 MiB a chunk", _one_chunk, SHOW),
    Bomb("log: a frame of 16 GB in a chunk of 1 kB", "both claim the same", _lying_chunk, CHECK),
    Bomb("log: 4 GB in chunks of 1 MB", "1 GiB + 16 x file", _many_chunks, CHECK),
    Bomb("log: 2,000,000 empty messages", "300,000 + file / 100 B", _many_messages, CHECK),
    Bomb("log: 200,000 ticks", _KEPT, _many_ticks, CHECK),
    Bomb("log: 20,000 events of 256 attributes", _KEPT, _large_mappings, CHECK),
    Bomb("log: an observation of 16,777,216 pictures", "8 pictures", _one_message, CHECK),
    Bomb("log: 25,000 ticks and 25,000 stamps", _KEPT, _ticks_and_chunks, CHECK),
    Bomb("log: a JPEG of 65500 x 65500 px, shown", "4096 px", _jpeg_header, SHOW),
    Bomb("log: a PNG of 65000 x 65000 px, shown", "4096 px", _png_header, SHOW),
    Bomb("residual head: arrays of 4 GB", "16 MiB", _npz, HEAD),
    Bomb("results: 200 MB of brackets", "64 MiB", _json, TABLES),
)


def run(bomb: Bomb, folder: Path) -> Row:
    path = folder / "file"
    bomb.make(path)
    words = [word.replace("FILE", str(path)).replace("FOLDER", str(folder)) for word in bomb.command]
    command = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    before_s = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    said = process.stdout.read().replace(f"{folder}/", "").strip().splitlines()
    _, status, usage = os.wait4(process.pid, 0)
    took_s = time.monotonic() - before_s
    return {
        "file": bomb.name,
        "size_kB": round(path.stat().st_size / 1e3, 1),
        "limit": bomb.limit,
        "exit": os.waitstatus_to_exitcode(status),
        "took_s": round(took_s, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_MB": round(usage.ru_maxrss / 1024),
        "said": said[-1][:160] if said else "",
    }


def main() -> int:
    report = Report(
        name="file_bombs",
        question="What does a file cost that claims more than it is, given to a command?",
        config=Options(),
        warm_up="none: each command is a process of its own, its start included",
    )
    rows = []
    for bomb in BOMBS:
        with tempfile.TemporaryDirectory(prefix="bomb-") as folder:
            rows.append(run(bomb, Path(folder)))
            print(rows[-1], flush=True)
    report.add_table("Files", rows)
    report.notes.append(
        "peak_MB is an upper bound: what the benchmark itself had when it started the command counts as well."
    )
    print(report.write())
    return 0


if __name__ == "__main__":
    sys.exit(main())
