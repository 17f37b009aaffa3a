"""Malformed messages at every topic and call of a robot in mid-episode: no crash, no motion, all counted.

Every kind of damage is refused by construction: what is flipped at random belongs to an epoch that never runs, so that
no lucky bit makes it a message somebody asked for.
"""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from protocol import codec, topics
from protocol import messages as m
from protocol.bus import Inbox, Request
from protocol.errors import MalformedMessage
from protocol.ponderpounce.v1 import common_pb2, episode_pb2, stream_pb2
from protocol.topics import Call, Priority, Topic
from sim_client.recorder import Recorder

NEVER = 0x5A5A5A  # an epoch many bits away from every other
DIM, FAR = 3, 1_000_000
ROW = np.zeros(DIM, np.float32)
CARRIERS = np.zeros((2, 8), np.float32)
FRAME = m.Image(camera="front", codec=m.ImageCodec.RAW, height=4, width=4, data=bytes(48))

GOOD: dict[Topic[Any], Any] = {
    topics.OBSERVATION: m.Observation(tick=3, source_ns=5, proprio=ROW, images=(FRAME, FRAME)),
    topics.QUERY: m.Query(query=FAR, tick=3, source_ns=5),
    topics.COGNITION: m.Cognition(query=FAR, tick=3, source_ns=5, ready_ns=6, vector=CARRIERS),
    topics.INVOCATION: m.Invocation(
        invocation=FAR, tick=3, now_ns=5, ref_query=0, age_ns=5, cognition=CARRIERS, previous_rows=ROW
    ),
    topics.CHUNK: m.ActionChunk(
        invocation=FAR, t_row0=3, horizon=20, action_dim=DIM, dt_ns=50, rows=np.ones(20 * DIM, np.float32),
        source_ns=5, ref_query=0, age_ns=0,
    ),
    topics.ACTION: m.Action(tick=FAR, deadline_ns=0, level=m.Level.PLAY, values=ROW + 1),
    topics.HEALTH: m.Health(state=m.ServingState.FAILED, detail="lies"),
    topics.TICK: m.Tick(tick=3, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.PLAY, action=ROW),
    topics.STAMP: m.Stamp(kind=m.StampKind.COGNITION, index=1, source_ns=0, ready_ns=0, arrived_ns=0),
    topics.EVENT: m.Event(severity=m.Severity.ERROR, name="lie", text="lies", attributes={"a": "b"}),
    topics.SUBGOAL: m.Subgoal(kind=m.SubgoalKind.SUBGOAL, text="lies", token_ids=(1, 2)),
    topics.PHASE: m.Phase(state="lies"),
    topics.RESULT: m.EpisodeResult(status=m.TaskStatus.SUCCESS, is_success=True, reason="lies", num_ticks=3),
}  # fmt: skip

HEARERS: dict[Topic[Any], tuple[str, ...]] = {
    topics.OBSERVATION: ("clock", "ponder", "pounce"),
    topics.QUERY: ("ponder",),
    topics.COGNITION: ("clock",),
    topics.INVOCATION: ("pounce",),
    topics.CHUNK: ("clock",),
    topics.ACTION: ("sim",),
    topics.HEALTH: ("clock",),
}

OVERSIZED = common_pb2.Tensor(dtype=common_pb2.DTYPE_F32, shape=(2**31, 2**31), data=bytes(64))
CLAIMS: dict[Topic[Any], Any] = {
    topics.OBSERVATION: stream_pb2.Observation(
        tick=1, proprio=[0] * DIM, status=1,
        images=[common_pb2.Image(camera="front", codec=1, height=4096, width=4096, data=b"x")],
    ),
    topics.QUERY: stream_pb2.Query(query=2**64 - 1),
    topics.COGNITION: stream_pb2.Cognition(vector=OVERSIZED),
    topics.INVOCATION: stream_pb2.Invocation(ref_query=1, cognition=OVERSIZED),
    topics.CHUNK: stream_pb2.ActionChunk(horizon=2**32 - 1, action_dim=2**32 - 1, rows=[0.0], dt_ns=1, action_space=1),
    topics.ACTION: stream_pb2.Action(tick=1, level=1, values=[0.0] * 257),
    topics.HEALTH: stream_pb2.Health(state=3, progress=1e9),
}  # fmt: skip
NAN = float("nan")
NOT_NUMBERS: dict[Topic[Any], Any] = {
    topics.OBSERVATION: stream_pb2.Observation(tick=1, proprio=[NAN] * DIM, status=1),
    topics.COGNITION: stream_pb2.Cognition(
        vector=common_pb2.Tensor(dtype=1, shape=(2, 8), data=np.full(16, np.nan, "<f4").tobytes())
    ),
    topics.INVOCATION: stream_pb2.Invocation(previous_rows=[NAN]),
    topics.CHUNK: stream_pb2.ActionChunk(horizon=1, action_dim=3, rows=[0, NAN, 0], dt_ns=1, action_space=1),
    topics.ACTION: stream_pb2.Action(tick=1, level=1, values=[float("inf")] * DIM),
    topics.HEALTH: stream_pb2.Health(state=3, progress=NAN),
}
SHAPES: dict[Topic[Any], Any] = {  # well-formed, of this very episode, and of no use here
    topics.OBSERVATION: dataclasses.replace(
        GOOD[topics.OBSERVATION], proprio=np.zeros(9, np.float32), images=GOOD[topics.OBSERVATION].images[:1]
    ),
    topics.COGNITION: GOOD[topics.COGNITION],
    topics.CHUNK: dataclasses.replace(GOOD[topics.CHUNK], horizon=4, rows=np.zeros(4 * DIM, np.float32)),
}

Message = tuple[str, bytes, str]  # key, payload, encoding


class Mischief:
    """Malformed messages of every kind, in turn, from a seed."""

    def __init__(self, header: m.Header, seed: int) -> None:
        self._header = header
        self._rng = np.random.default_rng(seed)
        self.num_thrown: Counter[Topic[Any]] = Counter()

    def next(self, topic: Topic[Any]) -> Message:
        kinds: list[Callable[[Topic[Any]], Message | None]] = [
            self.noise, self.flipped, self.wrong_shape, self.not_a_number, self.oversized, self.wrong_key,
            self.wrong_robot, self.wrong_epoch, self.wrong_encoding, self.cut,
        ]  # fmt: skip
        number = self.num_thrown[topic]
        self.num_thrown[topic] += 1
        return kinds[number % len(kinds)](topic) or self.noise(topic)

    def noise(self, topic: Topic[Any]) -> Message:
        payload = self._rng.bytes(self._rng.integers(0, 80))
        return self._sent(topic, payload if self._is_refused(topic, payload) else b"\xff")

    def flipped(self, topic: Topic[Any]) -> Message | None:
        payload = bytearray(codec.encode(self._signed(topic, epoch=NEVER)))
        for _ in range(self._rng.integers(1, 3)):
            payload[self._rng.integers(len(payload))] ^= 1 << self._rng.integers(8)
        has_epoch = topic is not topics.HEALTH and topic is not topics.PHASE  # no episode, hence no epoch is checked
        return self._sent(topic, bytes(payload)) if has_epoch or self._is_refused(topic, bytes(payload)) else None

    def wrong_shape(self, topic: Topic[Any]) -> Message | None:
        if topic not in SHAPES:
            return None
        return self._sent(topic, codec.encode(dataclasses.replace(SHAPES[topic], header=self._header)))

    def not_a_number(self, topic: Topic[Any]) -> Message | None:
        return self._claimed(topic, NOT_NUMBERS)

    def oversized(self, topic: Topic[Any]) -> Message | None:
        return self._claimed(topic, CLAIMS)

    def wrong_key(self, topic: Topic[Any]) -> Message | None:
        if topic in (topics.HEALTH, topics.PHASE):
            return None
        key = topics.stream_key(topic, self._header.robot, "another", "liar")
        return key, codec.encode(self._signed(topic)), self._encoding(topic)

    def wrong_robot(self, topic: Topic[Any]) -> Message:
        return self._sent(topic, codec.encode(self._signed(topic, robot="r1")))

    def wrong_epoch(self, topic: Topic[Any]) -> Message | None:
        return None if topic is topics.HEALTH else self._sent(topic, codec.encode(self._signed(topic, epoch=NEVER)))

    def wrong_encoding(self, topic: Topic[Any]) -> Message:
        key, payload, _ = self._sent(topic, codec.encode(self._signed(topic)))
        return key, payload, "application/protobuf;ponderpounce.v2.Phase"

    def cut(self, topic: Topic[Any]) -> Message | None:
        payload = codec.encode(self._signed(topic, epoch=NEVER))
        payload = payload[: self._rng.integers(len(payload))]
        return self._sent(topic, payload) if self._is_refused(topic, payload) else None

    def _signed(self, topic: Topic[Any], **changes: Any) -> Any:
        return dataclasses.replace(GOOD[topic], header=dataclasses.replace(self._header, **changes))

    def _claimed(self, topic: Topic[Any], protos: dict[Topic[Any], Any]) -> Message | None:
        if topic not in protos:
            return None
        proto = type(protos[topic]).FromString(protos[topic].SerializeToString())
        proto.header.robot, proto.header.episode = self._header.robot, self._header.episode
        proto.header.epoch = self._header.epoch
        return self._sent(topic, proto.SerializeToString())

    def _sent(self, topic: Topic[Any], payload: bytes) -> Message:
        key = topics.stream_key(topic, self._header.robot, self._header.episode, "liar")
        return key, payload, self._encoding(topic)

    def _encoding(self, topic: Topic[Any]) -> str:
        return "application/protobuf;" + codec.type_name(topic.cls)

    def _is_refused(self, topic: Topic[Any], payload: bytes) -> bool:
        try:
            return bool(codec.decode(topic.cls, payload).header.robot != self._header.robot)
        except MalformedMessage:
            return True


COUNTS = [pytest.param(300, id="300"), pytest.param(1_000, id="1000")]


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)


@pytest.mark.parametrize("count", COUNTS)
def test_malformed_messages_change_nothing_and_are_all_counted(
    count: int, new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    num_steps, info = 250, episode_info(paper)
    _, undisturbed = new_rig().run(info, num_steps)

    rig = new_rig()
    mischief = Mischief(info.header, seed=1)

    def throw() -> None:
        for topic in GOOD:
            for _ in range(2):  # as many as every ring holds beside the message that is awaited
                if mischief.num_thrown[topic] < count:
                    key, payload, encoding = mischief.next(topic)
                    rig.bus.publish(key, payload, encoding=encoding, attachment=b"", priority=Priority.DATA)

    def throw_often() -> None:
        """All of it within the episode, while the robot still moves."""
        for _ in range(-(-count // (2 * (num_steps - 20)))):
            throw()
            rig.bus.run_participants()

    rig.meanwhile = throw_often
    outcome, disturbed = rig.run(info, num_steps)

    assert outcome.status == m.TaskStatus.SUCCESS
    assert set(mischief.num_thrown.values()) == {count}
    assert disturbed.commands == undisturbed.commands
    expected = Counter({proc: sum(count for hears in HEARERS.values() if proc in hears) for proc in rig.links})
    assert {proc: sum(link.dropped.values()) for proc, link in rig.links.items()} == dict(expected)


def test_every_way_of_refusing_is_reached(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    info = episode_info(paper)
    mischief = Mischief(info.header, seed=1)

    def throw() -> None:
        for topic in GOOD:
            key, payload, encoding = mischief.next(topic)
            rig.bus.publish(key, payload, encoding=encoding, attachment=b"", priority=Priority.DATA)

    rig.meanwhile = throw
    rig.run(info, 100)
    reasons = {"malformed", "wrong_encoding", "wrong_robot", "wrong_episode", "other_episode"}
    reached = {proc: set(link.dropped) for proc, link in rig.links.items()}
    heard = {"clock": {"stranger"}, "ponder": {"stranger"}, "pounce": {"stranger"}, "sim": set()}
    assert reached == {proc: reasons | also for proc, also in heard.items()}


def test_the_recorder_survives_what_the_servers_survive(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    info = episode_info(paper)
    recorder = Recorder(rig.listener, "jpeg")
    rig.listener.enter_episode(info.header.session, info.header.episode, info.header.epoch)
    recorder.begin(info, None)
    mischief = Mischief(info.header, seed=2)
    for _ in range(500):
        for topic in GOOD:
            key, payload, encoding = mischief.next(topic)
            rig.bus.publish(key, payload, encoding=encoding, attachment=b"", priority=Priority.DATA)
        recorder.step()
    assert rig.listener.dropped["malformed"] > 1000


# -- calls

REQUESTS: dict[Call, Any] = {
    topics.CLOSE: m.CloseRequest(header=m.Header(robot="r0", episode="another")),
    topics.ACTIVE: m.ActiveRequest(header=m.Header(robot="r0")),
    topics.JOURNAL: m.JournalRequest(header=m.Header(robot="r0", episode="another"), first_query=0, max_queries=4),
    topics.TIME: m.TimeRequest(header=m.Header(robot="r0"), t0_ns=4),
    topics.ENGAGE: m.EngageRequest(header=m.Header(robot="r0"), operator="nobody in particular"),
}
SERVED = {"clock": [topics.OPEN, *REQUESTS], "ponder": [topics.OPEN, topics.CLOSE, topics.TIME]}
SERVED["pounce"] = SERVED["ponder"]


def broken_call(call: Call, good: Any, rng: np.random.Generator) -> bytes:
    """Bytes that are no request of this call: noise, a flipped bit, a cut end, or a claim out of bounds."""
    claims = {
        topics.JOURNAL: episode_pb2.JournalRequest(max_queries=2**32 - 1),
        topics.TIME: episode_pb2.TimeRequest(t0_ns=2**62),
        topics.OPEN: episode_pb2.OpenRequest(),
    }
    while True:
        payload = bytearray(codec.encode(good))
        kind = rng.integers(4)
        if kind == 0:
            payload = bytearray(rng.bytes(rng.integers(0, 80)))
        elif kind == 1:
            payload[rng.integers(len(payload))] ^= 1 << rng.integers(8)
        elif kind == 2:
            payload = payload[: rng.integers(len(payload))]
        elif call in claims:
            payload = bytearray(claims[call].SerializeToString())
        try:
            codec.decode(call.request, bytes(payload))
        except MalformedMessage:
            return bytes(payload)


@pytest.mark.parametrize("count", COUNTS)
def test_malformed_calls_change_nothing_and_are_all_refused(
    count: int, new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    num_steps, info = 250, episode_info(paper)
    _, undisturbed = new_rig().run(info, num_steps)

    rig = new_rig()
    rng = np.random.default_rng(5)
    requests = REQUESTS | {topics.OPEN: m.OpenRequest(info=info)}
    answers: dict[tuple[str, Call], list[bytes]] = {(proc, call): [] for proc in SERVED for call in SERVED[proc]}
    broken = {call: [broken_call(call, good, rng) for _ in range(50)] for call, good in requests.items()}

    def throw() -> None:
        for (proc, call), replies in answers.items():
            inbox: Inbox = rig.bus.serve(topics.call_key(call, "r0", proc))
            for _ in range(min(20, count - len(replies))):
                inbox.put(Request(broken[call][rng.integers(50)], replies.append))

    def throw_often() -> None:
        for _ in range(-(-count // (20 * (num_steps - 20)))):
            throw()
            rig.bus.run_participants()

    rig.meanwhile = throw_often
    outcome, disturbed = rig.run(info, num_steps)

    assert outcome.status == m.TaskStatus.SUCCESS
    assert disturbed.commands == undisturbed.commands
    refusals = {
        (proc, call.name): sum(codec.decode(call.reply, reply).error != "" for reply in replies)
        for (proc, call), replies in answers.items()
    }
    assert set(refusals.values()) == {count}
    assert {p: rig.links[p].dropped["refused_call"] for p in SERVED} == {p: count * len(SERVED[p]) for p in SERVED}


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_nobody_closes_an_episode_that_is_not_the_open_one(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule, proc: str
) -> None:
    rig.enter(episode_info(paper))
    stranger = rig.listener
    stranger.enter_episode("s1", "another", 9)
    reply = stranger.call(topics.CLOSE, proc, m.CloseRequest(), timeout_ns=1)
    assert reply.error == "episode 'another' is not open here"
    assert rig.links[proc].episode == "ep-1"
