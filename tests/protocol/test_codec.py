"""What is decoded is what was encoded, for every message; and anything else is refused."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from enum import IntEnum
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol import codec
from protocol import messages as m
from protocol.checks import (
    CHECKS,
    MAX_INDEX,
    MAX_INSTANT_NS,
    MAX_MESSAGE_BYTES,
    MAX_PLAIN_MESSAGE_BYTES,
    MAX_TEXT,
    MAX_UNIX_NS,
    check,
)
from protocol.errors import MalformedMessage, ProtocolError
from protocol.ponderpounce.v1 import common_pb2, episode_pb2, stream_pb2

PROTO_MODULES = (common_pb2, stream_pb2, episode_pb2)
CLASSES = [cls for cls in vars(m).values() if dataclasses.is_dataclass(cls)]
ENUMS = [cls for cls in vars(m).values() if isinstance(cls, type) and issubclass(cls, IntEnum) and cls is not IntEnum]
WIRE_ONLY = {"Tensor", "DType"}  # how arrays travel; inside they are numpy arrays

INDEX = st.integers(0, MAX_INDEX - 1)
U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
INSTANT = st.integers(-MAX_INSTANT_NS, MAX_INSTANT_NS)
ANCHOR = st.integers(-MAX_INSTANT_NS // 2, MAX_INSTANT_NS // 2)
DURATION = st.integers(0, MAX_INSTANT_NS)
TEXT = st.text(max_size=30)
LONG = "x" * (MAX_TEXT + 1)
NUMBER = st.floats(width=32, allow_nan=False, allow_infinity=False)
DOUBLE = st.floats(allow_nan=False)


def floats(low: int = 0, high: int = 12) -> st.SearchStrategy[m.Floats]:
    return hnp.arrays(np.float32, st.integers(low, high), elements=NUMBER)


def maps(values: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.dictionaries(TEXT, values, max_size=4)


def chosen(enum: type[IntEnum]) -> st.SearchStrategy[Any]:
    return st.sampled_from([value for value in enum if value])


def tuples_of(strategy: st.SearchStrategy[Any], most: int = 3) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.lists(strategy, max_size=most).map(tuple)


HEADER = st.builds(
    m.Header, robot=TEXT, session=TEXT, episode=TEXT, epoch=U32, proc=TEXT, boot_id=U64, seq=INDEX, clock_id=TEXT,
    at_ns=INSTANT,
)  # fmt: skip
CARRIERS = hnp.arrays(np.float32, st.tuples(st.integers(1, 3), st.integers(1, 6)), elements=NUMBER)
VECTORS = CARRIERS | st.just(np.zeros((0, 0), np.float32))


@st.composite
def pictures(draw: st.DrawFn) -> m.Image:
    height, width = draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    codec_ = draw(chosen(m.ImageCodec))
    if codec_ == m.ImageCodec.RAW:
        data = draw(st.binary(min_size=height * width * 3, max_size=height * width * 3))
    else:
        data = b"" if codec_ == m.ImageCodec.ELSEWHERE else draw(st.binary(min_size=1, max_size=40))
    return m.Image(camera=draw(TEXT), codec=codec_, height=height, width=width, crc32=draw(U32), data=data)


@st.composite
def cognitions(draw: st.DrawFn) -> m.Cognition:
    text_source_ns, source_ns = sorted(draw(st.tuples(DURATION, DURATION)))
    text = draw(st.none() | TEXT)
    return m.Cognition(
        header=draw(HEADER),
        query=draw(INDEX),
        tick=draw(INDEX),
        source_ns=source_ns,
        ready_ns=draw(INSTANT),
        vector=draw(CARRIERS if text is None else VECTORS),
        is_transition=draw(st.booleans()),
        context_tokens=draw(U32),
        infer_ns=draw(DURATION),
        norm=draw(NUMBER),
        model_hash=draw(TEXT),
        is_fake=draw(st.booleans()),
        text=text,
        text_source_ns=text_source_ns if text else 0,
        gate_score=draw(st.none() | NUMBER),
    )


@st.composite
def invocations(draw: st.DrawFn) -> m.Invocation:
    is_null = draw(st.booleans())
    text = None if is_null else draw(st.none() | TEXT)
    return m.Invocation(
        header=draw(HEADER),
        invocation=draw(INDEX),
        tick=draw(INDEX),
        now_ns=draw(INSTANT),
        ref_query=None if is_null else draw(INDEX),
        age_ns=0 if is_null else draw(DURATION),
        cognition=np.zeros((0, 0), np.float32) if is_null else draw(VECTORS if text is not None else CARRIERS),
        seed=draw(U64),
        previous_rows=draw(floats()),
        committed_rows=draw(U32),
        num_samples=draw(U32),
        text=text,
        text_age_ns=draw(DURATION) if text else 0,
    )


@st.composite
def chunks(draw: st.DrawFn) -> m.ActionChunk:
    horizon, action_dim = draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    return m.ActionChunk(
        header=draw(HEADER),
        invocation=draw(INDEX),
        t_row0=draw(INDEX),
        horizon=horizon,
        action_dim=action_dim,
        dt_ns=draw(st.integers(1, MAX_INSTANT_NS)),
        rows=draw(floats(horizon * action_dim, horizon * action_dim)),
        source_ns=draw(INSTANT),
        ref_query=draw(st.none() | INDEX),
        age_ns=draw(DURATION),
        infer_ns=draw(DURATION),
        action_space=draw(chosen(m.ActionSpace)),
        padded_video_ticks=draw(PAST),
        padded_state_ticks=draw(PAST),
        reference_state=draw(floats()),
        seed=draw(U64),
        model_hash=draw(TEXT),
        is_fake=draw(st.booleans()),
        previous_rows=draw(floats()),
        committed_rows=draw(U32),
        features=draw(st.binary(max_size=20)),
    )


@st.composite
def robots(draw: st.DrawFn) -> m.Robot:
    dim, num_proprio = draw(st.integers(1, 8)), draw(st.integers(0, 8))
    bounds = np.sort(np.stack([draw(floats(dim, dim)), draw(floats(dim, dim))]), axis=0)
    described = draw(st.just(()) | st.tuples(*(dimensions(index) for index in range(dim))))
    states = np.sort(np.stack([draw(floats(num_proprio, num_proprio)) for _ in range(2)]), axis=0)
    return m.Robot(
        name=draw(TEXT),
        command_low=bounds[0],
        command_high=bounds[1],
        max_step=np.abs(draw(floats(dim, dim))),
        initial_command=bounds[draw(st.integers(0, 1))],
        cameras=draw(tuples_of(TEXT)),
        image_height=draw(U32),
        image_width=draw(U32),
        num_proprio=num_proprio,
        is_simulated=draw(st.booleans()),
        max_lead=np.abs(draw(floats(dim, dim))) if not described else np.zeros(dim, np.float32),
        state_low=states[0],
        state_high=states[1],
        dimensions=described,
        control_hz=draw(st.just(0) | st.integers(5, 100)),
        stop_ticks=draw(U32),
        max_picture_age_ns=draw(DURATION),
        max_picture_skew_ns=draw(DURATION),
        max_picture_still_ns=draw(DURATION),
        at_exit=draw(st.sampled_from(m.AtExit)),
        home=bounds[draw(st.integers(0, 1))],
    )


def dimensions(index: int) -> st.SearchStrategy[m.Dimension]:
    """One that is not measured and may have any limits; what fits together is for ``test_robot_checks``."""
    joint, gripper = (m.DimensionKind.POSITION, m.AtStop.HOLD), (m.DimensionKind.GRIPPER, m.AtStop.KEEP)
    return st.tuples(st.sampled_from([joint, gripper]), TEXT).map(
        lambda drawn: m.Dimension(name=f"dim {index}", kind=drawn[0][0], unit=drawn[1], at_stop=drawn[0][1])
    )


@st.composite
def stamps(draw: st.DrawFn) -> m.Stamp:
    source_ns, ready_ns = sorted(draw(st.tuples(INSTANT, INSTANT)))
    return m.Stamp(
        header=draw(HEADER),
        kind=draw(chosen(m.StampKind)),
        index=draw(INDEX),
        source_ns=source_ns,
        ready_ns=ready_ns,
        arrived_ns=draw(INSTANT),
        is_transition=draw(st.booleans()),
    )


@st.composite
def time_replies(draw: st.DrawFn) -> m.TimeReply:
    t1_ns, t2_ns = sorted(draw(st.tuples(INSTANT, INSTANT)))
    return m.TimeReply(error=draw(TEXT), clock_id=draw(TEXT), t1_ns=t1_ns, t2_ns=t2_ns)


DELAY = st.builds(m.Delay, kind=chosen(m.DelayKind), mean_ns=DURATION, sigma=st.floats(0, 3))
DELIVERY = st.builds(m.Delivery, kind=chosen(m.DeliveryKind), reported_age_ns=DURATION)
SEAM = st.builds(m.Seam, kind=chosen(m.SeamKind), fade_ticks=U32, ensemble_decay=st.floats(-10, 10))
SCHEDULE = st.builds(
    m.Schedule, mode=chosen(m.Mode), control_hz=st.integers(1, 1000), horizon=st.integers(1, 1000),
    query_period_ns=st.integers(1, MAX_INSTANT_NS), invoke_period_ticks=st.integers(1, 2**32 - 1), query_delay=DELAY,
    invoke_delay=DELAY, delivery=DELIVERY, wait=chosen(m.WaitKind), seam=SEAM, max_age_ns=INSTANT,
    stale_limit_ns=INSTANT, hold_limit_ticks=U32, decelerate_ticks=U32, max_ticks=U32, seed=U64,
)  # fmt: skip
OF_ANY_RATE = robots().map(lambda robot: dataclasses.replace(robot, control_hz=0))
INFO = st.builds(
    m.EpisodeInfo, header=HEADER, task=TEXT, suite=TEXT, seed=U64, difficulty=TEXT, instruction=TEXT,
    schedule=SCHEDULE, robot=OF_ANY_RATE,
    t0_unix_ns=st.integers(0, MAX_UNIX_NS), versions=maps(TEXT), policy=TEXT, has_demo=st.booleans(),
)  # fmt: skip
RESULT = st.builds(
    m.EpisodeResult, header=HEADER, status=chosen(m.TaskStatus), is_success=st.booleans(), reason=TEXT,
    num_ticks=INDEX, stream_sha256=TEXT, statistics=maps(DOUBLE),
)  # fmt: skip
DEMO_FRAME = st.builds(m.DemoFrame, images=tuples_of(pictures()))
MEMBER = st.builds(m.Member, proc=TEXT, boot_id=U64)
OPEN_REQUEST = st.builds(m.OpenRequest, info=INFO, demo=tuples_of(DEMO_FRAME, 2), members=tuples_of(MEMBER, 4))
DEMO_SAMPLING = st.builds(m.DemoSampling, hz=st.sampled_from([1, 2, 4, 5, 10, 20]), to_its_end=st.booleans())
CHANNEL = st.builds(
    m.ChannelSpec, payload=st.sampled_from(m.PayloadKind), consumer=st.sampled_from(m.ConsumerKind),
    reads_age=st.booleans(), null=st.sampled_from(m.NullKind),
)  # fmt: skip
PAST = st.sets(st.integers(-100, -1), max_size=8).map(lambda ticks: tuple(sorted(ticks)))
OFFSETS = PAST.map(lambda ticks: (*ticks, 0))
WINDOW = st.builds(m.ObservationWindow, video_ticks=OFFSETS, state_ticks=OFFSETS)
CONTRACT = st.builds(
    m.Contract, proc=TEXT, num_carriers=U32, hidden_size=U32, horizon=U32, action_dim=U32,
    preferred_codec=chosen(m.ImageCodec), infer_p50_ns=DURATION, infer_p99_ns=DURATION, model_hash=TEXT,
    is_fake=st.booleans(), version=TEXT, context_tokens=U32, max_context_tokens=U32,
    demonstrations=st.none() | DEMO_SAMPLING, control_hz=st.integers(0, 100), channels=tuples_of(CHANNEL),
    window=st.none() | WINDOW,
)  # fmt: skip
JOURNAL_ENTRY = st.builds(
    m.JournalEntry, query=INDEX, tick=INDEX, source_ns=INSTANT, observation=st.binary(max_size=40)
)
any_row = hnp.arrays(np.uint32, st.integers(0, 8)).map(lambda bits: bits.view(np.float32))  # NaN payloads included

MESSAGES: dict[type, st.SearchStrategy[Any]] = {
    m.Header: HEADER,
    m.Image: pictures(),
    m.Observation: st.builds(
        m.Observation, header=HEADER, tick=INDEX, source_ns=INSTANT, proprio=floats(1), images=tuples_of(pictures()),
        status=chosen(m.TaskStatus), reason=TEXT,
    ),
    m.Query: st.builds(m.Query, header=HEADER, query=INDEX, tick=INDEX, source_ns=INSTANT),
    m.Cognition: cognitions(),
    m.Stamp: stamps(),
    m.Invocation: invocations(),
    m.ActionChunk: chunks(),
    m.Action: st.builds(
        m.Action, header=HEADER, tick=INDEX, deadline_ns=ANCHOR, level=chosen(m.Level), values=floats(1)
    ),
    m.Tick: st.builds(
        m.Tick, header=HEADER, tick=INDEX, deadline_ns=ANCHOR, decided_ns=INSTANT, late_ns=INSTANT,
        level=chosen(m.Level), invocation=st.none() | INDEX, t_row0=INDEX, row=U32, ref_query=st.none() | INDEX,
        age_ns=INSTANT, observation_tick=INDEX, state=floats(), action=floats(), raw_row=any_row, limits_hit=U32,
        seam_jump=NUMBER, age_ms=DOUBLE, late_ms=DOUBLE, picture_age_ns=tuples_of(INSTANT),
    ),
    m.Subgoal: st.builds(
        m.Subgoal, header=HEADER, kind=chosen(m.SubgoalKind), text=TEXT, tick=INDEX, query=st.none() | INDEX,
        token_ids=tuples_of(U32), is_truncated=st.booleans(),
    ),
    m.Event: st.builds(
        m.Event, header=HEADER, severity=chosen(m.Severity), name=TEXT, text=TEXT, tick=INDEX, attributes=maps(TEXT)
    ),
    m.Phase: st.builds(m.Phase, header=HEADER, state=TEXT),
    m.Health: st.builds(
        m.Health, header=HEADER, state=chosen(m.ServingState), progress=st.floats(0, 1, width=32), detail=TEXT,
        is_inferring=st.booleans(), open_episode=TEXT, next_index=INDEX, infer_p50_ns=INSTANT, infer_p99_ns=INSTANT,
        num_answered=INDEX, dropped=maps(U64), version=TEXT, model_hash=TEXT, is_fake=st.booleans(),
    ),
    m.Delay: DELAY,
    m.Delivery: DELIVERY,
    m.Seam: SEAM,
    m.Schedule: SCHEDULE,
    m.Robot: robots(),
    m.Dimension: dimensions(0),
    m.EpisodeInfo: INFO,
    m.EpisodeResult: RESULT,
    m.DemoFrame: DEMO_FRAME,
    m.OpenRequest: OPEN_REQUEST,
    m.Member: MEMBER,
    m.DemoSampling: DEMO_SAMPLING,
    m.ChannelSpec: CHANNEL,
    m.ObservationWindow: WINDOW,
    m.Contract: CONTRACT,
    m.ContractRequest: st.builds(m.ContractRequest, header=HEADER),
    m.ContractReply: st.builds(m.ContractReply, error=TEXT, contract=st.none() | CONTRACT),
    m.OpenReply: st.builds(
        m.OpenReply, error=TEXT, contract=st.none() | CONTRACT, contracts=tuples_of(CONTRACT),
        warnings=tuples_of(TEXT), try_again=st.booleans(), refusal=st.sampled_from(m.Refusal),
    ),
    m.CloseRequest: st.builds(m.CloseRequest, header=HEADER, result=st.none() | RESULT),
    m.CloseReply: st.builds(m.CloseReply, error=TEXT),
    m.ActiveRequest: st.builds(m.ActiveRequest, header=HEADER),
    m.ActiveReply: st.builds(
        m.ActiveReply, error=TEXT, open=st.none() | OPEN_REQUEST, num_queries=INDEX,
        owed_query=st.none() | INDEX, recent=tuples_of(st.binary(max_size=40)),
    ),
    m.JournalRequest: st.builds(
        m.JournalRequest, header=HEADER, first_query=INDEX, max_queries=st.integers(1, 64)
    ),
    m.JournalEntry: JOURNAL_ENTRY,
    m.JournalReply: st.builds(m.JournalReply, error=TEXT, entries=tuples_of(JOURNAL_ENTRY)),
    m.TimeRequest: st.builds(m.TimeRequest, header=HEADER, t0_ns=INSTANT),
    m.TimeReply: time_replies(),
    m.EngageRequest: st.builds(m.EngageRequest, header=HEADER, operator=st.text(min_size=1, max_size=30)),
    m.EngageReply: st.builds(m.EngageReply, error=TEXT, level=TEXT),
}  # fmt: skip


def bits_of(value: Any) -> Any:
    """``value`` as nested tuples that are equal only if every array and every number is, bit for bit."""
    if dataclasses.is_dataclass(value):
        return type(value), tuple(bits_of(getattr(value, f.name)) for f in dataclasses.fields(value))
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, tuple):
        return tuple(bits_of(item) for item in value)
    if isinstance(value, dict):
        return {key: bits_of(item) for key, item in value.items()}
    if isinstance(value, float):
        return value.hex()
    return bytes(value) if isinstance(value, memoryview) else value


def test_every_message_class_has_a_strategy() -> None:
    assert set(MESSAGES) == set(CLASSES)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_decoding_inverts_encoding(cls: type, data: st.DataObject) -> None:
    message = data.draw(MESSAGES[cls])
    assert bits_of(codec.decode(cls, codec.encode(message))) == bits_of(message)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_a_dataclass_has_its_message_fields_in_order(cls: type) -> None:
    proto = codec.proto_class(cls).DESCRIPTOR
    assert [f.name for f in dataclasses.fields(cls)] == [f.name for f in proto.fields]


@pytest.mark.parametrize("enum", ENUMS, ids=lambda e: e.__name__)
def test_an_enum_has_its_values_and_names(enum: type[IntEnum]) -> None:
    proto = next(
        module.DESCRIPTOR.enum_types_by_name.get(enum.__name__)
        for module in PROTO_MODULES
        if enum.__name__ in module.DESCRIPTOR.enum_types_by_name
    )
    prefix = "".join("_" + c if c.isupper() else c.upper() for c in enum.__name__).lstrip("_") + "_"
    assert {prefix + value.name: value.value for value in enum} == {v.name: v.number for v in proto.values}


def test_every_protobuf_type_has_a_python_type() -> None:
    names = {name for module in PROTO_MODULES for name in module.DESCRIPTOR.message_types_by_name}
    names |= {name for module in PROTO_MODULES for name in module.DESCRIPTOR.enum_types_by_name}
    assert names - WIRE_ONLY == {cls.__name__ for cls in (*CLASSES, *ENUMS)}


@pytest.mark.parametrize("cls", [c for c in CLASSES if "header" in {f.name for f in dataclasses.fields(c)}])
@given(data=st.data())
@settings(max_examples=5, deadline=None)
def test_a_message_without_header_has_an_empty_one(cls: type, data: st.DataObject) -> None:
    """Proto3 writes nothing for an absent sub-message; a receiver must find a header to distrust."""
    proto = codec.proto_class(cls)()
    proto.ParseFromString(codec.encode(data.draw(MESSAGES[cls])))
    proto.ClearField("header")
    assert bits_of(codec.decode(cls, proto.SerializeToString()).header) == bits_of(m.Header())


@pytest.mark.parametrize(
    ("cls", "field"),
    [
        (m.OpenRequest, "info"),
        (m.EpisodeInfo, "schedule"),
        (m.EpisodeInfo, "robot"),
        (m.Schedule, "query_delay"),
        (m.Schedule, "invoke_delay"),
    ],
)
@given(data=st.data())
@settings(max_examples=5, deadline=None)
def test_a_required_part_that_is_absent_is_named(cls: type, field: str, data: st.DataObject) -> None:
    proto = codec.proto_class(cls)()
    proto.ParseFromString(codec.encode(data.draw(MESSAGES[cls])))
    proto.ClearField(field)
    with pytest.raises(MalformedMessage, match=rf"{cls.__name__}\.{field}: expected"):
        codec.decode(cls, proto.SerializeToString())


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
@given(payload=st.binary(max_size=200))
@settings(max_examples=60, deadline=None)
def test_any_bytes_decode_or_are_refused(cls: type, payload: bytes) -> None:
    with contextlib.suppress(MalformedMessage):
        assert isinstance(codec.decode(cls, payload), cls)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
@given(data=st.data())
@settings(max_examples=12, deadline=None)
def test_a_flipped_bit_decodes_or_is_refused(cls: type, data: st.DataObject) -> None:
    payload = bytearray(codec.encode(data.draw(MESSAGES[cls])))
    if payload:
        payload[data.draw(st.integers(0, len(payload) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with contextlib.suppress(MalformedMessage):
        codec.encode(codec.decode(cls, bytes(payload)))


def with_a_long_text(value: Any) -> Iterator[Any]:
    """The value with one of its texts, wherever it is, longer than any may be."""
    if isinstance(value, str):
        yield LONG
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            for longer in with_a_long_text(getattr(value, field.name)):
                yield dataclasses.replace(value, **{field.name: longer})  # type: ignore[type-var]
    elif isinstance(value, tuple):
        for place, each in enumerate(value):
            yield from ((*value[:place], longer, *value[place + 1 :]) for longer in with_a_long_text(each))
    elif isinstance(value, dict):
        for key, each in value.items():
            yield value | {LONG: each}
            yield from (value | {key: longer} for longer in with_a_long_text(each))


@pytest.mark.parametrize("cls", CHECKS, ids=lambda c: c.__name__)
@given(data=st.data())
@settings(max_examples=8, deadline=None)
def test_no_text_of_any_message_is_longer_than_a_server_can_quote(cls: type, data: st.DataObject) -> None:
    for longer in with_a_long_text(data.draw(MESSAGES[cls])):
        with pytest.raises(MalformedMessage):
            check(longer)


@pytest.mark.parametrize(
    "message",
    [
        m.Event(severity=m.Severity.ERROR, name="refused", text=LONG),
        m.Health(state=m.ServingState.FAILED, version="1", detail=LONG),
        m.OpenReply(error=LONG, warnings=("short", LONG)),
        m.CloseReply(error=LONG),
        m.EngageReply(error=LONG),
        m.CloseRequest(
            header=m.Header(),
            result=m.EpisodeResult(
                status=m.TaskStatus.ABORTED, is_success=False, reason=LONG, num_ticks=0, stream_sha256="",
                statistics={},
            ),
        ),
    ],
    ids=lambda message: type(message).__name__,
)  # fmt: skip
def test_words_for_people_that_quote_too_much_are_cut_and_sent(message: Any) -> None:
    sent = codec.decode(type(message), codec.encode(message))
    assert f"... ({len(LONG)} characters)" in repr(sent)
    assert repr(sent).startswith(repr(message)[:80])


@given(obs=MESSAGES[m.Observation])
@settings(max_examples=50, deadline=None)
def test_plain_protobuf_reads_a_spliced_observation(obs: m.Observation) -> None:
    proto = stream_pb2.Observation()
    proto.ParseFromString(codec.encode(obs))
    assert [(i.camera, i.data) for i in proto.images] == [(i.camera, bytes(i.data)) for i in obs.images]
    assert (proto.tick, proto.header.robot) == (obs.tick, obs.header.robot)


@given(obs=MESSAGES[m.Observation])
@settings(max_examples=50, deadline=None)
def test_an_observation_that_plain_protobuf_wrote_decodes(obs: m.Observation) -> None:
    proto = stream_pb2.Observation()
    proto.ParseFromString(codec.encode(obs))
    assert bits_of(codec.decode(m.Observation, proto.SerializeToString())) == bits_of(obs)


def cognition_bytes(dtype: int, shape: tuple[int, ...], data: bytes) -> bytes:
    tensor = common_pb2.Tensor(dtype=dtype, shape=shape, data=data)
    return bytes(stream_pb2.Cognition(vector=tensor).SerializeToString())


def test_every_finite_f16_widens_exactly() -> None:
    halves = np.arange(2**16, dtype=np.uint16).view(np.float16)
    halves = halves[np.isfinite(halves)].reshape(1, -1)
    payload = cognition_bytes(common_pb2.DTYPE_F16, halves.shape, halves.tobytes())
    vector = codec.decode(m.Cognition, payload).vector
    assert vector.dtype == np.float32
    assert (vector == halves.astype(np.float32)).all()


def test_every_finite_bf16_widens_exactly() -> None:
    bits = np.arange(2**16, dtype=np.uint16)
    expected = (bits.astype(np.uint32) << 16).view(np.float32)
    keep = np.isfinite(expected)
    payload = cognition_bytes(common_pb2.DTYPE_BF16, (1, int(keep.sum())), bits[keep].tobytes())
    assert codec.decode(m.Cognition, payload).vector.tobytes() == expected[keep].tobytes()


@pytest.mark.parametrize(
    ("dtype", "shape", "num_bytes"),
    [
        (common_pb2.DTYPE_F32, (2, 3), 23),
        (common_pb2.DTYPE_F32, (2, 3), 28),
        (common_pb2.DTYPE_F16, (2, 3), 11),
        (common_pb2.DTYPE_BF16, (2, 3), 13),
        (common_pb2.DTYPE_UNSPECIFIED, (2, 3), 24),
        (common_pb2.DTYPE_F32, (2**31, 2**31), 24),
        (common_pb2.DTYPE_F32, (6,), 24),
        (common_pb2.DTYPE_F32, (1, 1, 1, 1, 6), 24),
        (common_pb2.DTYPE_F32, (), 4),
        (common_pb2.DTYPE_F32, (0, 3), 0),
        (99, (2, 3), 24),
    ],
)
def test_a_tensor_that_is_not_what_it_claims_is_refused(dtype: int, shape: tuple[int, ...], num_bytes: int) -> None:
    with pytest.raises(MalformedMessage, match=r"Cognition\.vector: expected"):
        codec.decode(m.Cognition, cognition_bytes(dtype, shape, bytes(num_bytes)))


def test_decoded_arrays_are_read_only() -> None:
    action = m.Action(tick=1, deadline_ns=0, level=m.Level.PLAY, values=np.ones(3, np.float32))
    with pytest.raises(ValueError, match="read-only"):
        codec.decode(m.Action, codec.encode(action)).values[0] = 2


def test_an_oversized_message_is_refused_unread() -> None:
    with pytest.raises(MalformedMessage, match=rf"Phase\.\*: expected at most {MAX_PLAIN_MESSAGE_BYTES} bytes"):
        codec.decode(m.Phase, bytes(MAX_MESSAGE_BYTES + 1))


def test_a_value_of_the_wrong_type_is_named() -> None:
    with pytest.raises(MalformedMessage, match=r"Query\.tick: expected a value of its type, came 1\.5"):
        codec.encode(m.Query(query=1, tick=1.5, source_ns=0))  # type: ignore[arg-type]


def test_a_value_of_an_enum_that_came_later_decodes_as_unspecified() -> None:
    """So a reader of today keeps what a writer of tomorrow says besides; where a value is required, it is refused."""
    subgoal = stream_pb2.Subgoal(kind=99, text="grasp it", tick=1)  # type: ignore[arg-type]
    assert codec.decode(m.Subgoal, subgoal.SerializeToString()).kind == m.SubgoalKind.UNSPECIFIED
    reply = episode_pb2.OpenReply(error="not today", refusal=99)  # type: ignore[arg-type]
    assert codec.decode(m.OpenReply, reply.SerializeToString()).refusal == m.Refusal.UNSPECIFIED
    action = stream_pb2.Action(tick=1, level=99, values=[0.0])  # type: ignore[arg-type]
    with pytest.raises(MalformedMessage, match=r"Action\.level: expected a specified value"):
        codec.decode(m.Action, action.SerializeToString())


def test_a_class_of_another_protocol_is_refused() -> None:
    with pytest.raises(ProtocolError, match=r"int is not a message of ponderpounce\.v1"):
        codec.type_name(int)


def test_a_type_is_named_as_mcap_and_zenoh_want_it() -> None:
    assert codec.type_name(m.Tick) == "ponderpounce.v1.Tick"
