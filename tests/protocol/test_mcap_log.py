"""The log: bytes as they travelled, times that never run back, a file that a kill or a full disk leaves readable."""

from __future__ import annotations

import os
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from protocol import codec, images, topics
from protocol import messages as m
from protocol.errors import ProtocolError
from protocol.mcap_log import EpisodeLog, log_topic, read_log, read_pictures, recover

T0 = 1_700_000_000_000_000_000
MS = 1_000_000


@pytest.fixture(scope="session")
def info() -> m.EpisodeInfo:
    delay = m.Delay(kind=m.DelayKind.FIXED, mean_ns=300 * MS)
    return m.EpisodeInfo(
        header=header(0, "sim"),
        task="PickHighlight",
        suite="tests",
        seed=7,
        difficulty="easy",
        instruction="Pick.",
        schedule=m.Schedule(
            mode=m.Mode.LOCKSTEP,
            control_hz=20,
            horizon=20,
            query_period_ns=1000 * MS,
            invoke_period_ticks=20,
            query_delay=delay,
            invoke_delay=delay,
            max_age_ns=2000 * MS,
            stale_limit_ns=4000 * MS,
            hold_limit_ticks=4,
            decelerate_ticks=10,
            max_ticks=100,
        ),
        robot=m.Robot(
            name="arm",
            command_low=np.full(2, -1, np.float32),
            command_high=np.full(2, 1, np.float32),
            max_step=np.zeros(2, np.float32),
            initial_command=np.zeros(2, np.float32),
            cameras=("front",),
            image_height=16,
            image_width=24,
            num_proprio=2,
            is_simulated=True,
        ),
        t0_unix_ns=T0,
        versions={"git": "abc"},
    )


RESULT = m.EpisodeResult(
    status=m.TaskStatus.SUCCESS, is_success=True, reason="done", num_ticks=3, stream_sha256="ab", statistics={"x": 0.5}
)


def header(at_ns: int, proc: str = "clock", clock_id: str = m.EPISODE_CLOCK, seq: int = 0) -> m.Header:
    return m.Header(robot="arm", session="s", episode="e", epoch=1, proc=proc, seq=seq, clock_id=clock_id, at_ns=at_ns)


def tick(number: int) -> m.Tick:
    at_ns = 50 * MS * number
    return m.Tick(header=header(at_ns, seq=number), tick=number, deadline_ns=at_ns, decided_ns=at_ns, late_ns=0,
                  level=m.Level.HOLD, action=np.array([0.25, number], np.float32))  # fmt: skip


def observation(codec_used: m.ImageCodec) -> m.Observation:
    frame = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)
    packed = images.pack({"front": frame}, codec_used)
    return m.Observation(header=header(50 * MS, "sim"), tick=1, source_ns=49 * MS, proprio=np.ones(2, np.float32),
                         images=packed)  # fmt: skip


def put(log: EpisodeLog, topic: Any, message: Any, wall_ns: int = T0) -> bytes:
    payload = codec.encode(message)
    log.write(topic, message, payload, wall_ns)
    return payload


def messages_in(path: Path) -> list[tuple[str, Any, Any]]:
    """(schema name, channel, message) in file order, read by the library's seeking reader: indexes and CRCs count."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [(s.name, c, x) for s, c, x in reader.iter_messages(log_time_order=False)]


ONE_OF_EACH: list[tuple[Any, Any, str]] = [
    (
        topics.OBSERVATION,
        m.Observation(header=header(1, "sim"), tick=0, source_ns=0, proprio=np.ones(2, np.float32)),
        "/observation",
    ),
    (topics.QUERY, m.Query(header=header(2), query=0, tick=0, source_ns=0), "/query"),
    (
        topics.COGNITION,
        m.Cognition(
            header=header(9, "ponder", "host/ponder"),
            query=0,
            tick=0,
            source_ns=0,
            ready_ns=1,
            vector=np.ones((1, 4), np.float32),
        ),
        "/s2/cognition",
    ),
    (
        topics.STAMP,
        m.Stamp(header=header(3), kind=m.StampKind.COGNITION, index=0, source_ns=0, ready_ns=3, arrived_ns=3),
        "/stamp",
    ),
    (
        topics.INVOCATION,
        m.Invocation(
            header=header(4),
            invocation=0,
            tick=0,
            now_ns=4,
            ref_query=None,
            age_ns=0,
            cognition=np.zeros((0, 0), np.float32),
        ),
        "/s1/invocation",
    ),
    (
        topics.CHUNK,
        m.ActionChunk(
            header=header(9, "pounce", "host/pounce"),
            invocation=0,
            t_row0=0,
            horizon=1,
            action_dim=2,
            dt_ns=50 * MS,
            rows=np.ones(2, np.float32),
            source_ns=4,
            ref_query=None,
            age_ns=0,
        ),
        "/s1/chunk",
    ),
    (
        topics.ACTION,
        m.Action(header=header(5), tick=0, deadline_ns=5, level=m.Level.PLAY, values=np.ones(2, np.float32)),
        "/action",
    ),
    (topics.TICK, tick(0), "/tick"),
    (topics.SUBGOAL, m.Subgoal(header=header(6, "ponder"), kind=m.SubgoalKind.SUBGOAL, text="pick"), "/s2/subgoal"),
    (topics.SUBGOAL, m.Subgoal(header=header(6, "sim"), kind=m.SubgoalKind.TASK_SIMPLE, text="pick"), "/sim/subgoal"),
    (topics.EVENT, m.Event(header=header(7), severity=m.Severity.ERROR, name="starved", text="no rows"), "/events"),
    (topics.PHASE, m.Phase(header=header(8, "pounce"), state="infer"), "/s1/phase"),
    (topics.PHASE, m.Phase(header=header(8, "clock"), state="play"), "/clock/phase"),
    (topics.PHASE, m.Phase(header=header(8, "gripper"), state="closed"), "/gripper/phase"),
    (topics.HEALTH, m.Health(header=header(8, "ponder", "host/ponder"), state=m.ServingState.READY), "/health"),
    (topics.RESULT, replace(RESULT, header=header(9, "sim")), "/episode/result"),
]


def test_every_message_lands_on_its_topic_byte_for_byte(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    payloads = [put(log, topic, message) for topic, message, _ in ONE_OF_EACH]
    assert log.close(RESULT).error == ""
    logged = [(c.topic, s, x.data) for s, c, x in messages_in(tmp_path / "a.mcap") if s.startswith("ponderpounce.v1.")]
    expected = [
        (name, codec.type_name(topic.cls), payload)
        for (topic, _, name), payload in zip(ONE_OF_EACH, payloads, strict=True)
    ]
    assert logged == [("/episode/info", "ponderpounce.v1.EpisodeInfo", codec.encode(info)), *expected]


def test_every_stream_has_a_topic() -> None:
    names = [log_topic(topic, "ponder") for topic in topics.STREAMS]
    assert len(set(names)) == len(topics.STREAMS)


def test_what_is_read_is_what_was_written(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    for topic, message, _ in ONE_OF_EACH:
        put(log, topic, message)
    log.close(RESULT)
    record = read_log(tmp_path / "a.mcap")
    assert (record.recovered, record.why) == (False, "")
    assert record.info.task == "PickHighlight"
    assert record.result is not None
    assert record.result.statistics == {"x": 0.5}
    read = [*record.observations, *record.queries, *record.cognitions, *record.stamps, *record.invocations,
            *record.chunks, *record.actions, *record.ticks, *record.subgoals, *record.events, *record.phases,
            *record.healths, record.result]  # fmt: skip
    assert [codec.encode(x) for x in read] == [codec.encode(x) for _, x, _ in ONE_OF_EACH]


def test_metadata_says_what_ran_and_how_it_ended(info: m.EpisodeInfo, tmp_path: Path) -> None:
    EpisodeLog(tmp_path / "a.mcap", info).close(RESULT)
    metadata = read_log(tmp_path / "a.mcap").metadata
    assert metadata["ponderpounce.episode"]["t0_unix_ns"] == str(T0)
    assert metadata["ponderpounce.run"] == {"git": "abc", "robot": "arm", "policy": "servers", "pixels": "jpeg"}
    assert metadata["ponderpounce.result"]["status"] == "success"
    assert metadata["ponderpounce.result"]["dropped_messages"] == "0"


@settings(max_examples=30, deadline=None)
@given(instants=st.lists(st.tuples(st.integers(-(10**9), 10**10), st.booleans()), max_size=30))
def test_log_time_is_episode_time_and_never_runs_back(
    instants: list[tuple[int, bool]], info: m.EpisodeInfo, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("t") / "a.mcap"
    log = EpisodeLog(path, info, when_full="wait")
    for number, (at_ns, is_episode) in enumerate(instants):
        stamped = header(at_ns, clock_id=m.EPISODE_CLOCK if is_episode else "host/ponder", seq=number)
        put(log, topics.PHASE, m.Phase(header=stamped, state="x"), wall_ns=T0 + number)
    log.close()
    expected, newest = [], T0
    for at_ns, is_episode in instants:
        newest = max(newest, T0 + at_ns) if is_episode else newest
        expected.append(newest)
    found = [x for _, c, x in messages_in(path) if c.topic == "/clock/phase"]
    assert [x.log_time for x in found] == expected
    assert [x.publish_time for x in found] == [T0 + n for n in range(len(instants))]
    assert [x.sequence for x in found] == list(range(len(instants)))


def test_raw_pixels_become_jpeg_on_the_cameras_channel(info: m.EpisodeInfo, tmp_path: Path) -> None:
    seen = observation(m.ImageCodec.RAW)
    log = EpisodeLog(tmp_path / "a.mcap", info)
    put(log, topics.OBSERVATION, seen)
    log.close()
    (logged,) = read_log(tmp_path / "a.mcap").observations
    (image,) = logged.images
    assert (image.codec, len(image.data), image.crc32) == (m.ImageCodec.ELSEWHERE, 0, zlib.crc32(seen.images[0].data))
    (picture,) = read_pictures(tmp_path / "a.mcap")
    assert (picture.camera, picture.source_ns, picture.format) == ("front", 49 * MS, "jpeg")
    assert picture.data == images.jpeg(images.unpack(seen.images[0]))


def test_pixels_that_travelled_as_jpeg_are_not_encoded_again(info: m.EpisodeInfo, tmp_path: Path) -> None:
    seen = observation(m.ImageCodec.JPEG)
    log = EpisodeLog(tmp_path / "a.mcap", info)
    put(log, topics.OBSERVATION, seen)
    log.close()
    (picture,) = read_pictures(tmp_path / "a.mcap")
    assert picture.data == bytes(seen.images[0].data)


def test_exact_keeps_the_observation_as_it_travelled(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info, pixels="exact")
    payload = put(log, topics.OBSERVATION, observation(m.ImageCodec.RAW))
    log.close()
    assert [x.data for _, c, x in messages_in(tmp_path / "a.mcap") if c.topic == "/observation"] == [payload]
    assert len(list(read_pictures(tmp_path / "a.mcap"))) == 1


def test_a_frame_that_is_redrawn_after_write_is_logged_as_it_travelled(info: m.EpisodeInfo, tmp_path: Path) -> None:
    frame = np.zeros((16, 24, 3), np.uint8)
    packed = images.pack({"front": frame}, m.ImageCodec.RAW)
    seen = replace(observation(m.ImageCodec.RAW), images=packed)
    payload = codec.encode(seen)
    frame[:] = 255  # the renderer's buffer, of which ``seen`` is a view
    log = EpisodeLog(tmp_path / "a.mcap", info, pixels="exact")
    log.write(topics.OBSERVATION, seen, payload, T0)
    log.close()
    (logged,) = read_log(tmp_path / "a.mcap").observations
    assert images.unpack(logged.images[0]).max() == 0


def test_events_and_subgoals_are_text_for_any_viewer(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    for topic, message, _ in ONE_OF_EACH:
        put(log, topic, message)
    log.close()
    lines = [(c.topic, x.data) for s, c, x in messages_in(tmp_path / "a.mcap") if s == "foxglove.Log"]
    assert [name for name, _ in lines] == ["/log/s2", "/log/sim", "/log/clock"]
    assert b"subgoal: pick" in lines[0][1]
    assert b"starved: no rows" in lines[2][1]


def test_all_channels_stand_in_the_first_chunk(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    head = (tmp_path / "a.mcap.partial").read_bytes()
    log.close()
    (tmp_path / "head.mcap").write_bytes(head)
    record = read_log(tmp_path / "head.mcap")
    assert record.recovered
    recover(tmp_path / "head.mcap", tmp_path / "whole.mcap")
    with (tmp_path / "whole.mcap").open("rb") as file:
        channels = {c.topic for c in make_reader(file).get_summary().channels.values()}
    assert {"/tick", "/s1/phase", "/s2/phase", "/sim/phase", "/clock/phase", "/camera/front", "/log/s2"} <= channels


@pytest.fixture
def whole(info: m.EpisodeInfo, tmp_path: Path) -> Path:
    log = EpisodeLog(tmp_path / "whole.mcap", info)
    for number in range(200):
        put(log, topics.TICK, tick(number))
    log.close(RESULT)
    return tmp_path / "whole.mcap"


def test_every_prefix_is_read_up_to_its_cut_and_can_be_recovered(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    counts = []
    for percent in range(0, 100, 3):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(content[: len(content) * percent // 100])
        rescued = tmp_path / f"rescued{percent}.mcap"
        try:
            record = read_log(cut)
        except ProtocolError:
            assert counts == []  # only a head too short for the first chunk holds nothing
            continue
        assert record.recovered
        assert [t.tick for t in record.ticks] == list(range(len(record.ticks)))
        counts.append(len(record.ticks))
        assert recover(cut, rescued).why == record.why
        again = read_log(rescued)
        assert [codec.encode(t) for t in again.ticks] == [codec.encode(t) for t in record.ticks]
        assert again.recovered
        assert again.why == record.why
        assert len(messages_in(rescued)) == len(again.ticks) + 1 + (again.result is not None)
    assert counts == sorted(counts)
    assert counts[-1] == 200


def test_a_flipped_bit_ends_the_reading_there_and_is_named(whole: Path, tmp_path: Path) -> None:
    content = bytearray(whole.read_bytes())
    where = len(read_log(whole).ticks)
    with whole.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    content[chunks[len(chunks) // 2].chunk_start_offset + 60] ^= 1
    (tmp_path / "flipped.mcap").write_bytes(content)
    record = read_log(tmp_path / "flipped.mcap")
    assert record.recovered
    assert 0 < len(record.ticks) < where
    assert "damaged" in record.why


@pytest.mark.parametrize("content", [b"", b"hello", bytes(200), b"\x89MCAP0\r\n" + b"\x06" + b"\xff" * 20])
def test_what_is_no_log_is_refused_with_its_name(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "odd.mcap").write_bytes(content)
    with pytest.raises(ProtocolError, match=r"odd\.mcap"):
        read_log(tmp_path / "odd.mcap")
    with pytest.raises(ProtocolError, match=r"odd\.mcap"):
        recover(tmp_path / "odd.mcap", tmp_path / "new.mcap")


def test_a_second_of_episode_time_is_the_most_a_kill_can_take(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    for number in range(100):
        put(log, topics.TICK, tick(number))
    while log._queue.qsize():  # the thread takes them; a kill now would leave the file as it is
        pass
    left = (tmp_path / "a.mcap.partial").read_bytes()
    log.close()
    (tmp_path / "left.mcap").write_bytes(left)
    assert len(read_log(tmp_path / "left.mcap").ticks) >= 79


def test_an_existing_record_is_never_overwritten(info: m.EpisodeInfo, tmp_path: Path) -> None:
    EpisodeLog(tmp_path / "a.mcap", info).close()
    with pytest.raises(FileExistsError, match="never overwritten"):
        EpisodeLog(tmp_path / "a.mcap", info)
    (tmp_path / "b.mcap.partial").write_bytes(b"evidence of a crash")
    with pytest.raises(FileExistsError):
        EpisodeLog(tmp_path / "b.mcap", info)


class _StuckThread:
    """In place of the writer thread: takes nothing until it is joined."""

    def __init__(self, *, target: Any, **_: Any) -> None:
        self._target = target

    def start(self) -> None: ...

    def join(self) -> None:
        self._target()


def test_a_full_queue_drops_and_counts_instead_of_blocking(
    info: m.EpisodeInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("protocol.mcap_log.threading.Thread", _StuckThread)
    log = EpisodeLog(tmp_path / "a.mcap", info, queue_size=5)
    for number in range(9):
        put(log, topics.TICK, tick(number))
    log._queue.get_nowait()  # room for the last entry; a living thread makes it
    closing = log.close(RESULT)
    assert closing.dropped == {"tick": 4}
    record = read_log(closing.path)
    assert [t.tick for t in record.ticks] == [1, 2, 3, 4]
    assert record.metadata["ponderpounce.result"]["dropped_messages"] == "4"
    assert record.metadata["ponderpounce.result"]["dropped_tick"] == "4"


def test_a_full_disk_is_reported_at_close_and_leaves_the_partial(
    info: m.EpisodeInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    log = EpisodeLog(tmp_path / "a.mcap", info)
    monkeypatch.setattr(os, "fsync", full)
    for number in range(200):  # ten seconds: two fsyncs
        put(log, topics.TICK, tick(number))
    closing = log.close(RESULT)
    assert "No space left" in closing.error
    assert closing.path == tmp_path / "a.mcap.partial"
    assert closing.dropped["tick"] > 0
    assert not (tmp_path / "a.mcap").exists()
    assert len(read_log(closing.path).ticks) > 50


def test_after_close_nothing_is_written_and_closing_again_says_the_same(info: m.EpisodeInfo, tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "a.mcap", info)
    first = log.close(RESULT)
    put(log, topics.TICK, tick(0))
    assert log.close(None) == first
    assert read_log(first.path).ticks == []
