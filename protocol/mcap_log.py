"""One MCAP file per episode, the system of record: every message with its bytes as transmitted.

Time rule: ``log_time`` is ``t0_unix_ns`` plus the message's episode time (for a message on another clock, the last
``log_time``), and never decreases, because viewers replay on it; ``publish_time`` is the recorder's wall clock.

One exception to "as transmitted": with ``pixels="jpeg"`` an Observation is logged without its pixels (codec ELSEWHERE,
crc32 kept); they are on ``/camera/<camera>`` instead, unchanged and matching their crc32 if they were sent compressed;
raw ones as JPEG, good for viewing but not for running a model again. ``pixels="exact"`` keeps both.

Crash safety: all channels are in the first chunk, and a chunk ends at least every second of episode time and whenever
the queue is empty for a second, so a killed process loses at most that (``recover`` repairs the file).
Layout of the container: mcap.dev/spec. Only this file and `protocol.mcap_records` import mcap.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import queue
import threading
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, TypeVar

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Proto
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import Writer

from protocol import codec, disk, files, images, topics
from protocol import messages as m
from protocol.checks import check
from protocol.errors import ProtocolError
from protocol.mcap_records import Records
from protocol.topics import Topic
from protocol.version import version

T = TypeVar("T")

log = logging.getLogger(__name__)

LANES = {"ponder": "s2", "pounce": "s1"}  # topic prefix of a process; others use their own name
QUEUE_SIZE = 1024  # messages: at 20 Hz about 8 s, of which 160 observations hold 64 MB of raw 256 px pairs
FLUSH_NS = 1_000_000_000
FLUSHES_PER_FSYNC = 5
MAX_KEPT_BYTES = 64 << 20  # of messages in memory, and 16 times the file: 1300 ticks without pictures have 14 MB
_MESSAGE_BYTES, _ENTRY_BYTES = 2_000, 200  # measured: a decoded message beside its bytes, and an entry of a mapping

Pixels = Literal["jpeg", "exact"]
WhenFull = Literal["drop", "wait"]

_TOPICS = {
    "obs": "/observation",
    "query": "/query",
    "cognition": "/s2/cognition",
    "stamp": "/stamp",
    "invocation": "/s1/invocation",
    "chunk": "/s1/chunk",
    "action": "/action",
    "tick": "/tick",
    "subgoal": "/{lane}/subgoal",
    "event": "/events",
    "phase": "/{lane}/phase",
    "info": "/episode/info",
    "result": "/episode/result",
    "health": "/health",
    "shadow_cognition": "/shadow/cognition",
    "shadow_chunk": "/shadow/chunk",
}
_LEVELS = {m.Severity.INFO: Log.INFO, m.Severity.WARNING: Log.WARNING, m.Severity.ERROR: Log.ERROR}
_KNOWN_PROCS = ("clock", "ponder", "pounce", "sim")


def log_topic(topic: Topic[T], proc: str) -> str:
    """The MCAP topic of ``proc``'s messages on ``topic``: ``/tick``, ``/s2/phase``, ``/sim/subgoal``."""
    return _TOPICS[topic.name].format(lane=LANES.get(proc, proc))


@dataclass(frozen=True, slots=True, kw_only=True)
class Closing:
    """State of the closed file. If ``error`` is "", ``path`` is the finished file."""

    path: Path
    num_messages: int
    dropped: dict[str, int] = field(default_factory=dict)  # by topic name
    error: str = ""


class _Entry(NamedTuple):
    topic: Topic[Any]
    message: Any
    payload: bytes
    wall_ns: int


class _Last(NamedTuple):
    result: m.EpisodeResult | None


class EpisodeLog:
    """Writes one episode to ``<path>.partial`` in its own thread, and renames it to ``path`` when it is closed.

    Only the constructor raises: later a full queue drops and counts messages, and a full disk ends the recording;
    ``close`` reports both. Lockstep passes ``when_full="wait"``: there the world can wait, and the log has no gaps.

    Raises:
        FileExistsError: ``path`` or its ``.partial`` exists; a record is never overwritten.
        OSError: the file cannot be created.
        MalformedMessage: ``info`` breaks the protocol.
    """

    def __init__(
        self,
        path: Path,
        info: m.EpisodeInfo,
        *,
        pixels: Pixels = "jpeg",
        queue_size: int = QUEUE_SIZE,
        when_full: WhenFull = "drop",
    ) -> None:
        self.path = path
        self.partial = path.with_name(path.name + ".partial")
        if path.exists():
            raise FileExistsError(f"{path} exists: a record is never overwritten. Move it or record elsewhere")
        check(info)
        path.parent.mkdir(parents=True, exist_ok=True)
        file = self.partial.open("xb")
        try:
            with files.writing(self.partial):
                self._writer = _Writer(file, info, pixels)
        except BaseException:  # a full disk: leave it no file that holds nothing
            with suppress(OSError):
                file.close()
            self.partial.unlink()
            raise
        self._queue: queue.Queue[_Entry | _Last] = queue.Queue(queue_size)
        self._waits = when_full == "wait"
        self._overflowed: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._error = ""
        self._is_closed = False
        self._closing: Closing | None = None
        self._thread = threading.Thread(target=self._run, name="episode-log", daemon=True)
        self._thread.start()

    def write(self, topic: Topic[T], message: T, payload: bytes, wall_ns: int) -> None:
        """Queues one message and its bytes; ``wall_ns`` is the unix time of recording."""
        if self._is_closed:
            self._overflowed[topic.name] += 1
            return
        try:
            self._queue.put(_Entry(topic, message, payload, wall_ns), block=self._waits)
        except queue.Full:
            self._overflowed[topic.name] += 1

    def miss(self, topic: Topic[T], count: int) -> None:
        """Counts messages that never came here as dropped."""
        self._overflowed[topic.name] += count

    def close(self, result: m.EpisodeResult | None = None) -> Closing:
        """Finishes and renames the file, and reports losses. Closing again returns the same answer.

        Args:
            result: the episode's result; None if unknown.
        """
        if self._closing is None:
            self._is_closed = True
            self._queue.put(_Last(result))
            self._thread.join()
            dropped = dict(self._overflowed + self._refused)
            path = self.partial if self.partial.exists() else self.path
            self._closing = Closing(
                path=path, num_messages=self._writer.num_messages, dropped=dropped, error=self._error
            )
            if self._error or dropped:
                log.error("episode log path=%s dropped=%s error=%r", path, dropped, self._error)
        return self._closing

    def _run(self) -> None:
        """The thread: takes entries until the last one. After a failure it discards them, so that no writer blocks."""
        while not isinstance(entry := self._next(), _Last):
            if self._error:
                self._refused[entry.topic.name] += 1
                continue
            try:
                self._writer.write(entry)
            except ProtocolError as error:  # the message is invalid, the file is intact
                self._refused[entry.topic.name] += 1
                log.error("not logged topic=%s error=%r", entry.topic.name, str(error))
            except Exception as error:  # disk full or a bug here: it must not disturb the control loop
                self._refused[entry.topic.name] += 1
                self._fail(error)
        try:
            self._writer.finish(entry.result, self._overflowed + self._refused, self._error)
            if not self._error:
                self.partial.rename(self.path)
                disk.sync(self.path.parent)
        except Exception as error:
            self._fail(error)

    def _next(self) -> _Entry | _Last:
        """The next entry; flushes when none comes for a second."""
        with suppress(queue.Empty):
            return self._queue.get(timeout=FLUSH_NS / 1e9)
        if not self._error:
            try:
                self._writer.flush()
            except Exception as error:
                self._fail(error)
        return self._queue.get()

    def _fail(self, error: Exception) -> None:
        self._error = self._error or f"{type(error).__name__}: {error} (what was written lies in {self.partial})"
        log.error("episode log failed path=%s error=%r", self.partial, self._error)


class _Writer:
    """The file itself; used by one thread."""

    def __init__(self, file: BinaryIO, info: m.EpisodeInfo, pixels: Pixels) -> None:
        self._file = file
        self._is_exact = pixels == "exact"
        self._t0_ns = info.t0_unix_ns
        self._log_ns = info.t0_unix_ns
        self._flushed_ns = info.t0_unix_ns
        self._num_flushes = 0
        self._has_result = False
        self.num_messages = 0
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._mcap = Writer(file)  # zstd chunks of 1 MiB, all indexes, CRCs: the library's defaults
        self._mcap.start(profile="", library=f"ponderpounce/{version()}")
        self._mcap.add_metadata("ponderpounce.episode", _episode_metadata(info))
        self._mcap.add_metadata("ponderpounce.run", _run_metadata(info, pixels))
        for topic in topics.STREAMS:
            for proc in _KNOWN_PROCS if "{lane}" in _TOPICS[topic.name] else ("",):
                self._channel(log_topic(topic, proc), codec.proto_class(topic.cls))
        for camera in info.robot.cameras:
            self._channel(f"/camera/{camera}", CompressedImage)
        for proc in _KNOWN_PROCS:
            self._channel(f"/log/{LANES.get(proc, proc)}", Log)
        self._add(log_topic(topics.INFO, ""), m.EpisodeInfo, codec.encode(info), info.t0_unix_ns, info.header.seq)
        self.flush()

    def write(self, entry: _Entry) -> None:
        topic, message, payload, wall_ns = entry
        header: m.Header = message.header
        if header.clock_id == m.EPISODE_CLOCK:
            self._log_ns = max(self._log_ns, self._t0_ns + header.at_ns)
        if isinstance(message, m.Observation):
            payload = self._place_pixels(payload, wall_ns)
        self._add(log_topic(topic, header.proc), topic.cls, payload, wall_ns, header.seq)
        self._has_result |= isinstance(message, m.EpisodeResult)
        if isinstance(message, m.Event):
            self._say(header.proc, _LEVELS[message.severity], f"{message.name}: {message.text}", wall_ns)
        elif isinstance(message, m.Subgoal):
            self._say(header.proc, Log.INFO, f"{message.kind.name.lower()}: {message.text}", wall_ns)
        if self._log_ns - self._flushed_ns >= FLUSH_NS:
            self.flush()

    def flush(self) -> None:
        """Ends the chunk, so that what was written survives a kill; every fifth time also a power cut."""
        self._mcap.flush()
        self._flushed_ns = self._log_ns
        self._num_flushes += 1
        if self._num_flushes % FLUSHES_PER_FSYNC == 0:
            os.fsync(self._file.fileno())

    def finish(self, result: m.EpisodeResult | None, dropped: Counter[str], error: str) -> None:
        if error:  # the disk is full or the file is broken: leave it for ``recover``
            with suppress(OSError):
                self._file.close()
            return
        if result is not None and not self._has_result:
            self._add(log_topic(topics.RESULT, ""), m.EpisodeResult, codec.encode(result), self._log_ns, 0)
        self._mcap.add_metadata("ponderpounce.result", _result_metadata(result, dropped))
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _place_pixels(self, payload: bytes, wall_ns: int) -> bytes:
        """Writes an observation's pictures to their cameras' channels; returns the observation's bytes for the log.

        It decodes the bytes again, because the caller's message may be a view of a frame that is being overwritten.
        """
        observation = codec.decode(m.Observation, payload)
        carried = [i for i in observation.images if i.codec != m.ImageCodec.ELSEWHERE]
        for image in carried:
            picture = CompressedImage(frame_id=image.camera, format="jpeg", data=_compressed(image))
            if image.codec == m.ImageCodec.PNG:
                picture.format = "png"
            picture.timestamp.FromNanoseconds(self._t0_ns + observation.source_ns)
            self._add_proto(f"/camera/{image.camera}", picture, wall_ns)
        if self._is_exact or not carried:
            return payload
        return codec.encode(dataclasses.replace(observation, images=tuple(map(_without_pixels, observation.images))))

    def _say(self, proc: str, level: Any, text: str, wall_ns: int) -> None:
        line = Log(level=level, message=text, name=proc)
        line.timestamp.FromNanoseconds(self._log_ns)
        self._add_proto(f"/log/{LANES.get(proc, proc)}", line, wall_ns)

    def _add(self, name: str, cls: type, payload: bytes, wall_ns: int, sequence: int) -> None:
        channel = self._channel(name, codec.proto_class(cls))
        self._mcap.add_message(channel, self._log_ns, payload, wall_ns, sequence & 0xFFFF_FFFF)
        self.num_messages += 1

    def _add_proto(self, name: str, message: Proto, wall_ns: int) -> None:
        self._mcap.add_message(self._channel(name, type(message)), self._log_ns, message.SerializeToString(), wall_ns)

    def _channel(self, name: str, proto: type[Proto]) -> int:
        if name not in self._channels:
            full_name = proto.DESCRIPTOR.full_name
            if full_name not in self._schemas:
                described = _described(proto.DESCRIPTOR.file).SerializeToString()
                self._schemas[full_name] = self._mcap.register_schema(full_name, "protobuf", described)
            self._channels[name] = self._mcap.register_channel(name, "protobuf", self._schemas[full_name])
        return self._channels[name]


@dataclass(slots=True, kw_only=True)
class EpisodeRecord:
    """A log in memory, without pictures: each kind of message in logged order.

    ``recovered``: the file is unfinished or damaged, and these are the messages before that place, which ``why`` names.
    """

    info: m.EpisodeInfo
    result: m.EpisodeResult | None = None
    recovered: bool = False
    why: str = ""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    observations: list[m.Observation] = field(default_factory=list)
    queries: list[m.Query] = field(default_factory=list)
    cognitions: list[m.Cognition] = field(default_factory=list)
    stamps: list[m.Stamp] = field(default_factory=list)
    invocations: list[m.Invocation] = field(default_factory=list)
    chunks: list[m.ActionChunk] = field(default_factory=list)
    actions: list[m.Action] = field(default_factory=list)
    ticks: list[m.Tick] = field(default_factory=list)
    subgoals: list[m.Subgoal] = field(default_factory=list)
    events: list[m.Event] = field(default_factory=list)
    phases: list[m.Phase] = field(default_factory=list)
    healths: list[m.Health] = field(default_factory=list)
    shadow_cognitions: list[m.Cognition] = field(default_factory=list)
    """Answers of a PONDER that is asked like the other and never used."""
    shadow_chunks: list[m.ActionChunk] = field(default_factory=list)
    """Answers of a POUNCE that is asked like the other and never played."""


_LISTS: dict[type, str] = {
    m.Observation: "observations",
    m.Query: "queries",
    m.Cognition: "cognitions",
    m.Stamp: "stamps",
    m.Invocation: "invocations",
    m.ActionChunk: "chunks",
    m.Action: "actions",
    m.Tick: "ticks",
    m.Subgoal: "subgoals",
    m.Event: "events",
    m.Phase: "phases",
    m.Health: "healths",
    m.EpisodeInfo: "info",
    m.EpisodeResult: "result",
}
_SHADOW_LISTS: dict[type, str] = {m.Cognition: "shadow_cognitions", m.ActionChunk: "shadow_chunks"}
_CLASSES = {codec.type_name(cls): cls for cls in _LISTS}


def read_log(path: Path) -> EpisodeRecord:
    """Reads an episode, finished or not.

    Raises:
        OSError: the file cannot be opened.
        FileError: it is none of ours, holds more than one episode, or more than any episode needs.
    """
    lists: dict[str, list[Any]] = {name: [] for name in (*_LISTS.values(), *_SHADOW_LISTS.values())}
    metadata: dict[str, dict[str, str]] = {}
    with files.reading(path, "episode log"), files.open_file(path) as file:
        records = Records(file)
        room = MAX_KEPT_BYTES + 16 * records.num_bytes
        for record in records:
            if isinstance(record, Metadata):
                metadata[record.name] = dict(record.metadata)
            elif isinstance(record, Message) and (cls := _CLASSES.get(records.schema_of(record))):
                message: Any = codec.decode(cls, record.data)
                is_shadow = message.header.proc in topics.SHADOW_OF
                lists[_SHADOW_LISTS.get(cls, _LISTS[cls]) if is_shadow else _LISTS[cls]].append(message)
                room -= _num_bytes(message, record.data)
                if room < 0:
                    raise ValueError(f"its messages need more memory than an episode's, {MAX_KEPT_BYTES >> 20} MiB")
        infos, results = lists.pop("info"), lists.pop("result")
        if not infos:
            raise ValueError(f"no EpisodeInfo in it ({records.damage or 'another kind of log'})")
        _require_one_episode(infos, lists)
    return EpisodeRecord(
        info=infos[0],
        result=results[-1] if results else None,
        recovered=bool(records.damage) or "ponderpounce.recovered" in metadata,
        why=records.damage or metadata.get("ponderpounce.recovered", {}).get("why", ""),
        metadata=metadata,
        **lists,
    )


def _num_bytes(message: Any, payload: bytes) -> int:
    """About the memory that a decoded message takes."""
    entries = sum(len(getattr(message, name)) for name in _MAPPINGS.get(type(message), ()))
    return _MESSAGE_BYTES + len(payload) + _ENTRY_BYTES * entries


_MAPPINGS: dict[type, tuple[str, ...]] = {
    m.Event: ("attributes",),
    m.Health: ("dropped",),
    m.EpisodeInfo: ("versions",),
    m.EpisodeResult: ("statistics",),
}


def _require_one_episode(infos: list[m.EpisodeInfo], lists: dict[str, list[Any]]) -> None:
    """Raises ValueError if messages are of several episodes. Phases and healths are of processes, not of episodes."""
    found = Counter(info.header.episode for info in infos)
    for name in lists.keys() - {"phases", "healths"}:
        found |= Counter({message.header.episode: 1 for message in lists[name]})
    if found.total() > 1:
        raise ValueError(
            f"{found.total()} episodes in it ({', '.join(sorted(found.elements())[:4])}), as in merged logs; give one "
            "log per episode"
        )


class Picture(NamedTuple):
    """One camera's picture at ``source_ns`` of episode time: ``data`` in ``format`` ("jpeg" or "png")."""

    camera: str
    source_ns: int
    format: str
    data: bytes


def read_pictures(path: Path) -> Iterator[Picture]:
    """Yields all pictures in logged order, with one in memory at a time.

    Raises:
        OSError: the file cannot be opened.
        FileError: it is none of ours, or a picture is no JPEG or PNG, or larger than any camera's.
    """
    t0_ns = 0
    with files.open_file(path) as file:
        records = Records(file)
        for record in records:
            with files.reading(path, "episode log"):
                if isinstance(record, Metadata) and record.name == "ponderpounce.episode":
                    t0_ns = int(record.metadata["t0_unix_ns"])
                    continue
                if not isinstance(record, Message) or records.schema_of(record) != CompressedImage.DESCRIPTOR.full_name:
                    continue
                picture = CompressedImage.FromString(record.data)
                images.claimed_size(picture.data)
                source_ns = picture.timestamp.ToNanoseconds() - t0_ns
            yield Picture(picture.frame_id, source_ns, picture.format, picture.data)


class Recovery(NamedTuple):
    num_messages: int
    why: str  # "" if the source was whole


def recover(src: Path, dst: Path) -> Recovery:
    """Copies everything before the first damage into a finished file, in chunks and with all indexes.

    Raises:
        OSError: ``src`` cannot be read, or ``dst`` exists or cannot be written.
        FileError: no message could be read, or ``src`` unpacks to more than any episode's log.
    """
    num_messages = 0
    schemas, channels = {0: 0}, dict[int, int]()
    if dst.exists():
        raise FileExistsError(f"{dst} exists: a record is never overwritten. Name another file")
    with files.reading(src, "episode log"), files.open_file(src) as file:
        records = Records(file)
        head = next(iter(records), None)
        if not isinstance(head, Header):
            raise ValueError(f"nothing to recover ({records.damage or 'no MCAP header'})")
        with _new_file(dst) as out:
            writer = Writer(out)
            writer.start(head.profile, f"{head.library}; recovered")
            for record in records:
                if isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                elif isinstance(record, Channel) and record.id not in channels:
                    schema = schemas[record.schema_id]
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schema, record.metadata
                    )
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                    num_messages += 1
                elif isinstance(record, Metadata):
                    writer.add_metadata(record.name, record.metadata)
                elif isinstance(record, Attachment):
                    writer.add_attachment(
                        record.create_time, record.log_time, record.name, record.media_type, record.data
                    )
            if records.damage:
                why = {"why": records.damage, "num_messages": str(num_messages)}
                writer.add_metadata("ponderpounce.recovered", why)
            writer.finish()
            out.flush()
            os.fsync(out.fileno())
            if not num_messages:
                raise ValueError(f"not one whole message in it ({records.damage})")
    return Recovery(num_messages, records.damage)


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """A file that is complete, or is not there."""
    with files.writing(path), path.open("xb") as out:
        try:
            yield out
        except BaseException:
            path.unlink()
            raise


def _without_pixels(image: m.Image) -> m.Image:
    """The log's entry for a picture stored elsewhere: its size, and a checksum of the transmitted bytes."""
    crc32 = image.crc32 or zlib.crc32(image.data)  # not computed for raw pixels on the control path
    return dataclasses.replace(image, codec=m.ImageCodec.ELSEWHERE, crc32=crc32, data=b"")


def _compressed(image: m.Image) -> bytes:
    return images.jpeg(images.unpack(image)) if image.codec == m.ImageCodec.RAW else bytes(image.data)


def _episode_metadata(info: m.EpisodeInfo) -> dict[str, str]:
    values = {
        "episode": info.header.episode,
        "session": info.header.session,
        "task": info.task,
        "suite": info.suite,
        "seed": info.seed,
        "difficulty": info.difficulty,
        "instruction": info.instruction,
        "control_hz": info.schedule.control_hz,
        "max_ticks": info.schedule.max_ticks,
        "mode": info.schedule.mode.name.lower(),
        "t0_unix_ns": info.t0_unix_ns,
    }
    return {name: str(value) for name, value in values.items()}


def _run_metadata(info: m.EpisodeInfo, pixels: Pixels) -> dict[str, str]:
    return {**info.versions, "robot": info.robot.name, "policy": info.policy, "pixels": pixels}


def _result_metadata(result: m.EpisodeResult | None, dropped: Counter[str]) -> dict[str, str]:
    values: dict[str, object] = {"dropped_messages": dropped.total()}
    values |= {f"dropped_{topic}": count for topic, count in sorted(dropped.items())}
    if result is not None:
        values |= {
            "status": result.status.name.lower(),
            "is_success": str(result.is_success).lower(),
            "reason": result.reason,
            "num_ticks": result.num_ticks,
            "stream_sha256": result.stream_sha256,
            **{name: repr(number) for name, number in sorted(result.statistics.items())},
        }
    return {name: str(value) for name, value in values.items()}


def _described(file: Any) -> FileDescriptorSet:
    """``file`` and all its imports, dependencies first, so that the log is self-contained."""
    described = FileDescriptorSet()
    seen: set[str] = set()

    def add(one: Any) -> None:
        if one.name not in seen:
            seen.add(one.name)
            for dependency in one.dependencies:
                add(dependency)
            one.CopyToProto(described.file.add())

    add(file)
    return described
