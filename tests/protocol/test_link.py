"""A link signs what it sends, and drops, counts and tells once whatever it cannot trust. It never raises for a peer."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from protocol import codec, topics
from protocol import messages as m
from protocol.bus import ATTACHMENT_BYTES, LocalBus
from protocol.errors import CallFailed, MalformedMessage, ProtocolError
from protocol.link import Link, Stream
from protocol.topics import Priority

QUERY = m.Query(query=3, tick=4, source_ns=5)
ENCODING = "application/protobuf;ponderpounce.v1.Query"


@pytest.fixture
def bus() -> LocalBus:
    return LocalBus()


@pytest.fixture
def sender(bus: LocalBus) -> Link:
    link = Link(bus, robot="r0", proc="clock", boot_id=7)
    link.enter_episode("s1", "e1", 2)
    return link


@pytest.fixture
def receiver(bus: LocalBus) -> Link:
    link = Link(bus, robot="r0", proc="ponder", boot_id=8)
    link.enter_episode("s1", "e1", 2, [m.Member(proc="clock", boot_id=7)])
    return link


@pytest.fixture
def queries(receiver: Link) -> Stream[m.Query]:
    return receiver.subscribe(topics.QUERY)


def raw(
    bus: LocalBus,
    payload: bytes,
    *,
    key: str = "pp/@v1/r0/ep/e1/query",
    encoding: str = ENCODING,
    attachment: bytes = bytes(ATTACHMENT_BYTES),
) -> None:
    bus.publish(key, payload, encoding=encoding, attachment=attachment, priority=Priority.DATA)


def signed(**header: Any) -> bytes:
    values = {"robot": "r0", "session": "s1", "episode": "e1", "epoch": 2, "proc": "clock"} | header
    return codec.encode(dataclasses.replace(QUERY, header=m.Header(**values)))


def test_what_is_published_arrives_signed(sender: Link, queries: Stream[m.Query]) -> None:
    sender.publish(topics.QUERY, QUERY, at_ns=9)
    (query,) = queries.drain()
    expected = m.Header(
        robot="r0", session="s1", episode="e1", epoch=2, proc="clock", boot_id=7, seq=0, clock_id="episode", at_ns=9
    )
    assert dataclasses.asdict(query.header) == dataclasses.asdict(expected)
    assert (query.query, query.tick, query.source_ns) == (3, 4, 5)


def test_publish_returns_what_was_sent(sender: Link, queries: Stream[m.Query]) -> None:
    sent = sender.publish(topics.QUERY, QUERY, at_ns=9)
    (received,) = queries.receive()
    assert received.sample.payload == codec.encode(sent)


def test_sequence_numbers_count_per_topic(sender: Link, queries: Stream[m.Query]) -> None:
    for _ in range(3):
        sender.publish(topics.QUERY, QUERY, at_ns=0)
        sender.publish(topics.PHASE, m.Phase(state="x"), at_ns=0)
    assert [query.header.seq for query in queries.drain()] == [0, 1, 2]


def test_a_restarted_process_is_another_boot(bus: LocalBus) -> None:
    boots = {Link(bus, robot="r0", proc="ponder").boot_id for _ in range(8)}
    assert len(boots) == 8


def test_the_attachment_tells_order_instant_and_boot_without_decoding(sender: Link, queries: Stream[m.Query]) -> None:
    sender.publish(topics.QUERY, QUERY, at_ns=0)
    (received,) = queries.receive()
    attachment = received.sample.attachment
    numbers = [int.from_bytes(attachment[i : i + 8], "little") for i in range(0, ATTACHMENT_BYTES, 8)]
    assert numbers == [0, QUERY.source_ns, 7]


def test_all_episodes_of_a_robot_are_heard(sender: Link, queries: Stream[m.Query]) -> None:
    sender.enter_episode("s1", "e9", 3)
    sender.publish(topics.QUERY, QUERY, at_ns=0)
    assert [query.header.episode for query in queries.drain()] == ["e9"]


def test_another_robot_is_not_heard(bus: LocalBus, queries: Stream[m.Query]) -> None:
    Link(bus, robot="r1", proc="clock").publish(topics.QUERY, QUERY, at_ns=0)
    assert queries.drain() == []


@pytest.mark.parametrize(
    ("reason", "payload", "options"),
    [
        ("wrong_encoding", signed(), {"encoding": "application/protobuf;ponderpounce.v2.Query"}),
        ("wrong_encoding", signed(), {"encoding": ""}),
        ("malformed", b"\xff", {}),
        ("malformed", b"\x10\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01", {}),  # query 2**64 - 1
        ("malformed", signed()[:-1], {}),
        ("wrong_robot", signed(robot="r1"), {}),
        ("wrong_robot", b"", {}),  # proto3: every field at its default, so nobody signed it
        ("wrong_episode", signed(episode="e2"), {}),
    ],
)
class TestAMessageNobodyCanTrust:
    @pytest.fixture(autouse=True)
    def quiet(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.WARNING)

    def test_is_dropped(
        self, bus: LocalBus, queries: Stream[m.Query], reason: str, payload: bytes, options: dict[str, Any]
    ) -> None:
        raw(bus, payload, **options)
        assert queries.drain() == []

    def test_is_counted_by_its_reason(
        self,
        bus: LocalBus,
        receiver: Link,
        queries: Stream[m.Query],
        reason: str,
        payload: bytes,
        options: dict[str, Any],
    ) -> None:
        for _ in range(3):
            raw(bus, payload, **options)
        queries.drain()
        assert dict(receiver.dropped) == {reason: 3}

    def test_is_told_once(
        self,
        bus: LocalBus,
        queries: Stream[m.Query],
        caplog: pytest.LogCaptureFixture,
        reason: str,
        payload: bytes,
        options: dict[str, Any],
    ) -> None:
        for _ in range(3):
            raw(bus, payload, **options)
        queries.drain()
        assert [record.message.count(f"reason={reason}") for record in caplog.records] == [1]


def test_the_same_fault_of_another_boot_is_told_again(
    bus: LocalBus, queries: Stream[m.Query], caplog: pytest.LogCaptureFixture
) -> None:
    for boot in (1, 2, 2):
        raw(bus, b"\xff", attachment=bytes(16) + boot.to_bytes(8, "little"))
    queries.drain()
    assert len(caplog.records) == 2


def test_a_flood_of_sources_does_not_flood_the_log(
    bus: LocalBus, receiver: Link, caplog: pytest.LogCaptureFixture
) -> None:
    stream = receiver.subscribe(topics.QUERY, keep=2000)
    for boot in range(1500):
        raw(bus, b"\xff", attachment=bytes(16) + boot.to_bytes(8, "little"))
    stream.drain()
    assert (receiver.dropped["malformed"], len(caplog.records)) == (1500, 1000)


def test_a_good_message_behind_a_bad_one_arrives(sender: Link, bus: LocalBus, queries: Stream[m.Query]) -> None:
    raw(bus, b"\xff")
    sender.publish(topics.QUERY, QUERY, at_ns=0)
    assert len(queries.drain()) == 1


@pytest.mark.parametrize("size", [0, 23, 25])
def test_a_broken_attachment_harms_nothing(bus: LocalBus, queries: Stream[m.Query], size: int) -> None:
    raw(bus, signed(), attachment=bytes(size))
    assert len(queries.drain()) == 1


@pytest.mark.parametrize(
    ("header", "expected", "reason"),
    [
        (m.Header(episode="e1", epoch=2, proc="clock", boot_id=7), True, None),
        (m.Header(episode="e1", epoch=1, proc="clock", boot_id=7), False, "other_episode"),
        (m.Header(episode="e2", epoch=2, proc="clock", boot_id=7), False, "other_episode"),
        (m.Header(), False, "other_episode"),
        (m.Header(episode="e1", epoch=2, proc="clock", boot_id=6), False, "stranger"),
        (m.Header(episode="e1", epoch=2, proc="sim", boot_id=7), False, "stranger"),
        (m.Header(episode="e1", epoch=2, proc="pounce", boot_id=5), False, "stranger"),
    ],
)
def test_a_message_belongs_to_one_episode_and_is_its_members(
    receiver: Link, header: m.Header, expected: bool, reason: str | None
) -> None:
    receiver.admit(m.Member(proc="pounce", boot_id=4), m.Member(proc="sim", boot_id=3))
    assert receiver.is_from(header, "clock") is expected
    assert dict(receiver.dropped) == ({reason: 1} if reason else {})


def test_between_episodes_a_late_message_is_nobodys_fault(receiver: Link, caplog: pytest.LogCaptureFixture) -> None:
    receiver.leave_episode()
    assert not receiver.is_member(m.Header(episode="e1", epoch=2))
    assert dict(receiver.dropped) == {"no_episode": 1}
    assert caplog.records == []


@pytest.mark.parametrize(
    ("header", "is_logged"),
    [
        (m.Header(session="s", episode="e0", epoch=1), False),
        (m.Header(session="s", episode="e2", epoch=3), True),
        (m.Header(session="other", episode="e0", epoch=1), True),
    ],
    ids=["an earlier one of the session", "a later one", "another session's"],
)
def test_what_is_left_of_an_earlier_episode_is_counted_and_nobodys_fault(
    receiver: Link, header: m.Header, is_logged: bool, caplog: pytest.LogCaptureFixture
) -> None:
    receiver.enter_episode("s", "e1", 2)
    assert not receiver.is_member(header)
    assert dict(receiver.dropped) == {"other_episode": 1}
    assert bool(caplog.records) is is_logged


def test_a_stranger_is_one_alarm_however_much_it_says(bus: LocalBus, sender: Link, receiver: Link) -> None:
    alarms = sender.subscribe(topics.EVENT)
    stranger = Link(bus, robot="r0", proc="clock", boot_id=9)
    stranger.enter_episode("s1", "e1", 2)
    queries = receiver.subscribe(topics.QUERY)
    for _ in range(8):
        stranger.publish(topics.QUERY, QUERY, at_ns=0)
    assert [receiver.is_from(query.header, "clock") for query in queries.drain()] == [False] * 8
    (alarm,) = alarms.drain()
    assert (alarm.name, alarm.severity) == ("stranger", m.Severity.ERROR)
    assert "clock#9 is not the clock that this episode was opened with" in alarm.text
    assert receiver.dropped["stranger"] == 8


def test_a_strangers_flood_pushes_no_members_message_out(bus: LocalBus, sender: Link, receiver: Link) -> None:
    stranger = Link(bus, robot="r0", proc="clock", boot_id=9)
    stranger.enter_episode("s1", "e1", 2)
    queries = receiver.subscribe(topics.QUERY, keep=4)
    for link in (sender, *[stranger] * 100, sender, *[stranger] * 100):
        link.publish(topics.QUERY, QUERY, at_ns=0)
    obeyed = [query.header for query in queries.drain() if receiver.is_from(query.header, "clock")]
    assert [(header.boot_id, header.seq) for header in obeyed] == [(7, 0), (7, 1)]
    assert receiver.dropped["stranger"] == 200
    assert receiver.num_superseded() == {"query": 0}


def test_two_senders_under_one_name_are_noticed_and_the_second_is_not_heard(
    bus: LocalBus, sender: Link, receiver: Link
) -> None:
    double = Link(bus, robot="r0", proc="clock", boot_id=sender.boot_id)
    double.enter_episode("s1", "e1", 2)
    queries = receiver.subscribe(topics.QUERY)
    for link in (sender, sender, double):
        link.publish(topics.QUERY, QUERY, at_ns=0)
    assert [query.header.seq for query in queries.drain()] == [0, 1]
    assert receiver.second_sender == "two processes send as clock#7: message 0 after message 1"
    receiver.enter_episode("s1", "e2", 3)
    assert receiver.second_sender == ""


def test_what_a_ring_lost_is_no_second_sender(sender: Link, receiver: Link) -> None:
    queries = receiver.subscribe(topics.QUERY, keep=2)
    for _ in range(10):
        sender.publish(topics.QUERY, QUERY, at_ns=0)
    assert [query.header.seq for query in queries.drain()] == [8, 9]
    assert receiver.second_sender == ""


def test_our_own_malformed_message_is_a_bug_here(sender: Link) -> None:
    action = m.Action(tick=0, deadline_ns=0, level=m.Level.PLAY, values=np.full(2, np.nan, np.float32))
    with pytest.raises(MalformedMessage, match=r"Action\.values"):
        sender.publish(topics.ACTION, action, at_ns=0)


@pytest.mark.parametrize(("robot", "proc"), [("r/0", "clock"), ("r0", "*"), ("@r0", "clock")])
def test_a_name_that_keys_would_misread_is_refused(bus: LocalBus, robot: str, proc: str) -> None:
    with pytest.raises(ProtocolError, match="use 1 to 128 letters"):
        Link(bus, robot=robot, proc=proc)


def test_an_episode_that_keys_would_misread_is_refused(sender: Link) -> None:
    with pytest.raises(ProtocolError, match=r"episode 'e/\*'"):
        sender.enter_episode("s1", "e/*", 3)


# -- calls


@pytest.fixture
def serve_time(bus: LocalBus, receiver: Link) -> Callable[[Callable[[Any], Any]], None]:
    """Lets ``receiver`` answer TIME with a handler."""

    def start(handler: Callable[[Any], Any]) -> None:
        service = receiver.serve(topics.TIME)
        bus.add_participant(lambda: service.answer(handler) > 0)

    return start


def test_a_call_brings_back_the_reply(sender: Link, serve_time: Callable[[Any], None]) -> None:
    serve_time(lambda request: m.TimeReply(clock_id=request.header.proc, t1_ns=request.t0_ns, t2_ns=8))
    reply = sender.call(topics.TIME, "ponder", m.TimeRequest(t0_ns=6), timeout_ns=1)
    assert (reply.clock_id, reply.t1_ns, reply.t2_ns) == ("clock", 6, 8)


def test_a_refusal_is_a_sentence_in_the_reply(sender: Link, serve_time: Callable[[Any], None]) -> None:
    def refuse(request: Any) -> Any:
        raise ProtocolError("not today")

    serve_time(refuse)
    assert sender.call(topics.TIME, "ponder", m.TimeRequest(t0_ns=6), timeout_ns=1).error == "not today"


def test_a_call_that_does_not_decode_is_answered_and_counted(
    bus: LocalBus, receiver: Link, serve_time: Callable[[Any], None]
) -> None:
    serve_time(lambda request: m.TimeReply())
    key = topics.call_key(topics.TIME, "r0", "ponder")
    reply = codec.decode(m.TimeReply, bus.call(key, b"\xff", timeout_ns=1))
    assert reply.error.startswith("TimeRequest.*: expected ponderpounce.v1.TimeRequest bytes")
    assert dict(receiver.dropped) == {"refused_call": 1}


@pytest.mark.parametrize(
    "handler",
    [lambda request: m.TimeReply(t1_ns=8, t2_ns=7), lambda request: m.TimeReply(clock_id="c" * 1000)],
    ids=["times", "name"],
)
def test_a_reply_of_ours_that_breaks_the_protocol_ends_no_process(
    sender: Link, receiver: Link, serve_time: Callable[[Any], None], handler: Callable[[Any], Any]
) -> None:
    serve_time(handler)
    reply = sender.call(topics.TIME, "ponder", m.TimeRequest(t0_ns=6), timeout_ns=1)
    assert reply.error.startswith("unexpected error, see the log: TimeReply.")
    assert dict(receiver.dropped) == {"failed": 1}


def test_a_refusal_that_quotes_all_that_came_is_cut(sender: Link, serve_time: Callable[[Any], None]) -> None:
    def refuse(request: Any) -> Any:
        raise ProtocolError("expected less than " + "x" * 50_000)

    serve_time(refuse)
    error = sender.call(topics.TIME, "ponder", m.TimeRequest(t0_ns=6), timeout_ns=1).error
    assert error.startswith("expected less than xxx")
    assert error.endswith("... (50019 characters)")


def test_an_unreadable_answer_is_a_failed_call(bus: LocalBus, sender: Link) -> None:
    inbox = bus.serve(topics.call_key(topics.TIME, "r0", "ponder"))
    bus.add_participant(lambda: any([request.reply(b"\xff") is None for request in inbox.drain()]))
    with pytest.raises(CallFailed, match="unreadable answer: TimeReply"):
        sender.call(topics.TIME, "ponder", m.TimeRequest(t0_ns=6), timeout_ns=1)


def test_a_call_to_nobody_fails(sender: Link) -> None:
    with pytest.raises(CallFailed, match=r"pp/@v1/r0/@rpc/pounce/time within 5 ms: nobody serves it"):
        sender.call(topics.TIME, "pounce", m.TimeRequest(t0_ns=6), timeout_ns=5_000_000)
