"""Logs of others and of strangers: any container is read, and none costs more than an episode's log."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from clock import schedules
from protocol import codec, mcap_log, mcap_records, topics
from protocol import messages as m
from protocol.errors import FileError, MalformedMessage
from protocol.mcap_log import EpisodeLog, read_log, read_pictures, recover

PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"


def header(episode: str = "e") -> m.Header:
    return m.Header(robot="arm", session="s", episode=episode, epoch=1, proc="clock", clock_id=m.EPISODE_CLOCK)


def tick(number: int, episode: str = "e") -> m.Tick:
    at_ns = number * 50_000_000
    return m.Tick(header=dataclasses.replace(header(episode), at_ns=at_ns), tick=number, deadline_ns=at_ns,
                  decided_ns=at_ns, late_ns=0, level=m.Level.HOLD)  # fmt: skip


@pytest.fixture
def logged(tmp_path: Path) -> Callable[[str], Path]:
    """A log of twenty ticks."""

    def log(episode: str) -> Path:
        two = np.zeros(2, np.float32)
        robot = m.Robot(name="arm", command_low=two - 1, command_high=two + 1, max_step=two, initial_command=two,
                        cameras=("front",), image_height=16, image_width=16, num_proprio=2,
                        is_simulated=True)  # fmt: skip
        info = m.EpisodeInfo(header=header(episode), task="PickHighlight", suite="", seed=0, difficulty="easy",
                             instruction="", schedule=schedules.paper(), robot=robot, t0_unix_ns=1)  # fmt: skip
        path = tmp_path / f"{episode}.mcap"
        written = EpisodeLog(path, info, when_full="wait")
        for number in range(20):
            message = tick(number, episode)
            written.write(topics.TICK, message, codec.encode(message), 1)
        assert written.close().error == ""
        return path

    return log


Extra = tuple[tuple["type | str", bytes], ...]


def rewritten(path: Path, sources: list[Path], extra: Extra = (), **options: object) -> Path:
    """The messages of ``sources`` as another tool would write them, and ``extra`` ones (schema, payload)."""
    with path.open("wb") as file:
        writer = Writer(file, **options)  # type: ignore[arg-type]
        writer.start()
        for source in sources:
            schemas, channels = {0: 0}, {}
            for record in StreamReader(io.BytesIO(source.read_bytes())).records:
                if isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                elif isinstance(record, Channel) and record.id not in channels:
                    channels[record.id] = writer.register_channel(record.topic, "protobuf", schemas[record.schema_id])
                elif isinstance(record, Message):
                    writer.add_message(channels[record.channel_id], record.log_time, record.data, record.publish_time)
        named: dict[str, int] = {}
        for cls, payload in extra:
            name = cls if isinstance(cls, str) else codec.type_name(cls)
            if name not in named:
                named[name] = writer.register_channel("/x", "protobuf", writer.register_schema(name, "protobuf", b""))
            writer.add_message(named[name], 1, payload, 1)
        writer.finish()
    return path


def with_chunk(path: Path, packed: bytes, size: int, compression: str = "zstd") -> Path:
    """The log with one more chunk, which claims to have ``size`` bytes."""
    whole = path.read_bytes()
    chunks = [each for each in StreamReader(io.BytesIO(whole), emit_chunks=True).records if isinstance(each, Chunk)]
    at = whole.index(chunks[0].data) + len(chunks[0].data)
    builder = RecordBuilder()
    Chunk(compression=compression, data=packed, message_end_time=1, message_start_time=1, uncompressed_crc=0,
          uncompressed_size=size).write(builder)  # fmt: skip
    path.write_bytes(whole[:at] + builder.end() + whole[at:])
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
        {"enable_crcs": False},
    ],
    ids=["zstd", "lz4", "none", "unchunked", "no_summary", "no_crc"],
)
def test_a_log_is_read_from_any_container(
    options: dict[str, object], logged: Callable[[str], Path], tmp_path: Path
) -> None:
    other = rewritten(tmp_path / "other.mcap", [logged("e")], **options)
    record = read_log(other)
    assert (len(record.ticks), record.recovered) == (20, False)
    recover(other, tmp_path / "copy.mcap")
    assert len(read_log(tmp_path / "copy.mcap").ticks) == 20


@pytest.mark.parametrize("episodes", [("a", "b"), ("a", "a")])
def test_merged_logs_are_refused_as_such(
    episodes: tuple[str, str], logged: Callable[[str], Path], tmp_path: Path
) -> None:
    logs = {episode: logged(episode) for episode in set(episodes)}
    sources = [logs[episode] for episode in episodes]
    with pytest.raises(FileError, match=rf"merged\.mcap .*2 episodes in it \({', '.join(episodes)}\)"):
        read_log(rewritten(tmp_path / "merged.mcap", sources))


def test_a_message_of_another_episode_makes_it_two(logged: Callable[[str], Path], tmp_path: Path) -> None:
    odd = rewritten(tmp_path / "odd.mcap", [logged("a")], ((m.Tick, codec.encode(tick(0, "b"))),))
    with pytest.raises(FileError, match="2 episodes in it"):
        read_log(odd)


def test_a_chunk_beyond_the_limit_is_not_unpacked(logged: Callable[[str], Path]) -> None:
    zeros = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    with pytest.raises(FileError, match=r"e\.mcap is no episode log: its chunk .* unpacks to 5000000000 bytes"):
        read_log(with_chunk(logged("e"), zeros, 5_000_000_000))


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
@pytest.mark.parametrize("size", [1000, 2 << 20])
def test_a_chunk_that_lies_about_its_size_ends_the_log_there(
    size: int, compression: str, logged: Callable[[str], Path]
) -> None:
    import lz4.frame

    pack = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress, "": bytes}[compression]
    record = read_log(with_chunk(logged("e"), pack(bytes(1 << 20)), size, compression))
    assert "damaged" in record.why


def test_many_chunks_are_limited_together(
    logged: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_records, "MAX_UNPACKED_BYTES", 1 << 20)
    extra = (("foxglove.Other", bytes(200_000)),) * 50
    vast = rewritten(tmp_path / "vast.mcap", [logged("e")], extra, chunk_size=1)
    assert vast.stat().st_size < 200_000
    with pytest.raises(FileError, match=r"vast\.mcap .*1 MiB in all"):
        read_log(vast)


def test_messages_are_limited_by_number_and_by_memory(
    logged: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = logged("e")
    monkeypatch.setattr(mcap_records, "MAX_MESSAGES", 10)
    many = rewritten(tmp_path / "many.mcap", [path], (("foxglove.Other", b""),) * 5000)
    with pytest.raises(FileError, match=r"more than 10 messages in \d+ bytes"):
        read_log(many)
    monkeypatch.undo()
    monkeypatch.setattr(mcap_log, "MAX_KEPT_BYTES", 1 << 20)
    names = {f"{i}": "" for i in range(256)}
    event = m.Event(header=header(), severity=m.Severity.INFO, name="x", text="", attributes=names)
    heavy = rewritten(tmp_path / "heavy.mcap", [path], ((m.Event, codec.encode(event)),) * 100)
    with pytest.raises(FileError, match="need more memory than an episode's, 1 MiB"):
        read_log(heavy)
    assert len(read_log(path).ticks) == 20


def test_a_message_of_countless_parts_is_refused_before_they_are_made() -> None:
    with pytest.raises(MalformedMessage, match="more than 8 blobs"):
        codec.decode(m.Observation, b"\x2a\x00" * 1_000_000)
    with pytest.raises(MalformedMessage, match=f"at most {4 << 20} bytes"):
        codec.decode(m.Event, b"\x32\x00" * (3 << 20))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (PNG + (65_000).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0", r"1\.\.4096 px, came 65000 x 65000 px"),
        (PNG, "a PNG without a header"),
        (b"GIF89a" + bytes(20), "a JPEG or PNG picture"),
    ],
    ids=["vast", "cut", "gif"],
)
def test_a_logged_picture_is_looked_at_before_anyone_decodes_it(
    data: bytes, reason: str, logged: Callable[[str], Path], tmp_path: Path
) -> None:
    picture = mcap_log.CompressedImage(frame_id="front", data=data).SerializeToString()
    path = rewritten(tmp_path / "odd.mcap", [logged("e")], (("foxglove.CompressedImage", picture),))
    with pytest.raises(FileError, match=rf"odd\.mcap is no episode log: .*{reason}"):
        list(read_pictures(path))


def test_a_copy_never_replaces_a_file_and_leaves_none_behind(logged: Callable[[str], Path], tmp_path: Path) -> None:
    (tmp_path / "there").write_text("keep")
    with pytest.raises(FileExistsError, match="there exists"):
        recover(logged("e"), tmp_path / "there")
    assert (tmp_path / "there").read_text() == "keep"
    empty = rewritten(tmp_path / "empty.mcap", [])
    with pytest.raises(FileError, match=r"empty\.mcap .*not one whole message"):
        recover(empty, tmp_path / "new")
    assert not (tmp_path / "new").exists()
