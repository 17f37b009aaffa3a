"""Each rule refuses what breaks it, and says which field, what was expected and what came."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from protocol import checks, codec
from protocol import messages as m
from protocol.errors import MalformedMessage

NAN = np.array([0.0, np.nan], np.float32)
INFINITE = np.array([np.inf, 0.0], np.float32)
ROW = np.zeros(2, np.float32)
NO_FLOATS = np.zeros(0, np.float32)
CARRIERS = np.zeros((1, 4), np.float32)
DELAY = m.Delay(kind=m.DelayKind.FIXED, mean_ns=300_000_000)
LONG_ID = "x" * 129
LONG_TEXT = "x" * 20_001

SCHEDULE = m.Schedule(
    mode=m.Mode.LOCKSTEP, control_hz=20, horizon=20, query_period_ns=10**9, invoke_period_ticks=20, query_delay=DELAY,
    invoke_delay=DELAY, max_age_ns=10**9, stale_limit_ns=10**10, hold_limit_ticks=10, decelerate_ticks=10,
    max_ticks=100,
)  # fmt: skip
ROBOT = m.Robot(
    name="arm", command_low=-ROW - 1, command_high=ROW + 1, max_step=ROW, initial_command=ROW, cameras=("front",),
    image_height=4, image_width=4, num_proprio=2, is_simulated=True,
)  # fmt: skip
INFO = m.EpisodeInfo(
    task="t", suite="s", seed=0, difficulty="easy", instruction="go", schedule=SCHEDULE, robot=ROBOT, t0_unix_ns=0
)
IMAGE = m.Image(camera="front", codec=m.ImageCodec.RAW, height=2, width=2, data=bytes(12))
GOOD: dict[type, Any] = {
    type(message): message
    for message in (
        m.Header(),
        IMAGE,
        m.Observation(tick=0, source_ns=0, proprio=ROW, images=(IMAGE,)),
        m.Query(query=0, tick=0, source_ns=0),
        m.Cognition(query=0, tick=0, source_ns=0, ready_ns=0, vector=CARRIERS),
        m.Stamp(kind=m.StampKind.CHUNK, index=0, source_ns=5, ready_ns=5, arrived_ns=0),
        m.Invocation(invocation=0, tick=0, now_ns=0, ref_query=1, age_ns=3, cognition=CARRIERS),
        m.ActionChunk(
            invocation=0, t_row0=0, horizon=2, action_dim=1, dt_ns=50, rows=ROW, source_ns=0, ref_query=0, age_ns=0
        ),
        m.Action(tick=0, deadline_ns=0, level=m.Level.PLAY, values=ROW),
        m.Tick(tick=0, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.PLAY),
        m.Subgoal(kind=m.SubgoalKind.SUBGOAL, text="pick"),
        m.Event(severity=m.Severity.INFO, name="n", text="t"),
        m.Phase(state="idle"),
        m.Health(state=m.ServingState.READY),
        SCHEDULE,
        ROBOT,
        INFO,
        m.EpisodeResult(status=m.TaskStatus.SUCCESS, is_success=True, reason="", num_ticks=1),
        m.OpenRequest(info=INFO),
        m.Contract(proc="ponder"),
        m.ContractReply(),
        m.OpenReply(),
        m.CloseRequest(),
        m.CloseReply(),
        m.ActiveReply(),
        m.JournalRequest(first_query=0, max_queries=4),
        m.JournalReply(),
        m.TimeRequest(t0_ns=0),
        m.TimeReply(t1_ns=1, t2_ns=1),
        m.EngageRequest(operator="jane"),
        m.EngageReply(),
    )
}


def with_schedule(**changes: Any) -> m.Schedule:
    return dataclasses.replace(SCHEDULE, **changes)


BROKEN: list[tuple[type, dict[str, Any], str]] = [
    (m.Query, {"query": -1}, r"Query\.query: expected 0\.\.9007199254740991, came -1"),
    (m.Query, {"tick": 2**53 + 1}, r"Query\.tick: expected 0\.\."),
    (m.Action, {"deadline_ns": 10**18}, r"Action\.deadline_ns: expected nanoseconds within 15 years, came 1000"),
    (m.Tick, {"deadline_ns": 10**18}, r"Tick\.deadline_ns: expected nanoseconds within 15 years, came 1000"),
    (m.Query, {"source_ns": 10**18 + 1}, r"Query\.source_ns: expected nanoseconds within 31 years, came 1000"),
    (m.Query, {"header": m.Header(robot=LONG_ID)}, r"Header\.robot: expected at most 128 characters, came 129"),
    (m.Query, {"header": m.Header(episode=LONG_ID)}, r"Header\.episode: "),
    (m.Query, {"header": m.Header(at_ns=-(10**18) - 1)}, r"Header\.at_ns: "),
    (m.Observation, {"proprio": NAN}, r"Observation\.proprio: expected finite numbers, came NaN or infinity"),
    (m.Observation, {"proprio": INFINITE}, r"Observation\.proprio: expected finite numbers"),
    (m.Observation, {"proprio": NO_FLOATS}, r"Observation\.proprio: expected 1\.\.256 numbers, came \(0,\)"),
    (m.Observation, {"proprio": np.zeros((2, 2), np.float32)}, r"Observation\.proprio: .* came \(2, 2\)"),
    (m.Observation, {"status": m.TaskStatus.UNSPECIFIED}, r"Observation\.status: expected a specified value"),
    (m.Observation, {"reason": LONG_TEXT}, r"Observation\.reason: expected at most 20000 characters"),
    (m.Observation, {"images": (IMAGE,) * 9}, r"Observation\.images: expected at most 8, came 9"),
    (m.Image, {"camera": LONG_ID}, r"Image\.camera: "),
    (m.Image, {"codec": m.ImageCodec.UNSPECIFIED}, r"Image\.codec: expected a specified value"),
    (m.Image, {"height": 0}, r"Image\.height, width: expected 1\.\.4096 px, came \(0, 2\)"),
    (m.Image, {"width": 4097}, r"Image\.height, width: "),
    (m.Image, {"data": bytes(11)}, r"Image\.data: expected 12 bytes of RGB, came 11"),
    (m.Image, {"codec": m.ImageCodec.ELSEWHERE}, r"Image\.data: expected no bytes, came 12"),
    (m.Image, {"codec": m.ImageCodec.JPEG, "data": b""}, r"Image\.data: expected a compressed image, came 0 bytes"),
    (m.Image, {"codec": m.ImageCodec.PNG, "data": bytes(4121)}, r"Image\.data: .* came 4121 bytes"),
    (m.Cognition, {"vector": np.zeros(4, np.float32)}, r"Cognition\.vector: expected \(K <= 64, H <= 65536\)"),
    (m.Cognition, {"vector": np.zeros((65, 1), np.float32)}, r"Cognition\.vector: .* came \(65, 1\)"),
    (m.Cognition, {"vector": np.zeros((1, 65_537), np.float32)}, r"Cognition\.vector: "),
    (m.Cognition, {"vector": np.zeros((0, 0), np.float32)}, r"Cognition\.vector: "),
    (m.Cognition, {"vector": NAN[None]}, r"Cognition\.vector: expected finite numbers"),
    (m.Cognition, {"text": "x" * 20_001}, r"Cognition\.text: expected at most 20000 characters"),
    (m.Cognition, {"gate_score": math.nan}, r"Cognition\.gate_score: expected a finite number, or none, came nan"),
    (m.Cognition, {"text_source_ns": -5}, r"Cognition\.text_source_ns: expected 0 without a text"),
    (m.Cognition, {"text": "", "text_source_ns": -5}, r"Cognition\.text_source_ns: expected 0 without a text"),
    (m.Cognition, {"text": "go", "text_source_ns": 1}, r"Cognition\.text_source_ns: expected <= 0, came 1"),
    (m.Cognition, {"text": "go", "text_source_ns": -(2 * 10**18)}, r"Cognition\.text_source_ns: expected <= 0"),
    (m.Cognition, {"infer_ns": -1}, r"Cognition\.infer_ns: expected a duration within 31 years, came -1"),
    (m.Cognition, {"model_hash": LONG_ID}, r"Cognition\.model_hash: "),
    (m.Stamp, {"kind": m.StampKind.UNSPECIFIED}, r"Stamp\.kind: "),
    (m.Stamp, {"ready_ns": 4}, r"Stamp\.ready_ns: expected >= source_ns 5, came 4"),
    (m.Invocation, {"ref_query": None}, r"Invocation\.age_ns: expected 0 for null cognition, came 3"),
    (m.Invocation, {"cognition": np.zeros((0, 0), np.float32)}, r"Invocation\.cognition: expected the vector of"),
    (m.Invocation, {"cognition": NAN[None]}, r"Invocation\.cognition: expected finite numbers"),
    (
        m.Invocation,
        {"ref_query": None, "age_ns": 0, "cognition": np.zeros((0, 0), np.float32), "text": ""},
        r"Invocation\.text: expected nothing for null",
    ),
    (m.Invocation, {"text_age_ns": 3}, r"Invocation\.text_age_ns: expected 0 without a text"),
    (m.Invocation, {"text": "go", "text_age_ns": -3}, r"Invocation\.text_age_ns: expected a duration"),
    (m.Invocation, {"age_ns": -1}, r"Invocation\.age_ns: expected a duration"),
    (m.Invocation, {"previous_rows": NAN}, r"Invocation\.previous_rows: expected finite numbers"),
    (m.ActionChunk, {"rows": NAN}, r"ActionChunk\.rows: expected finite numbers"),
    (m.ActionChunk, {"horizon": 3}, r"ActionChunk\.rows: expected 3\.\.3 numbers, came \(2,\)"),
    (m.ActionChunk, {"horizon": 1_001}, r"ActionChunk\.horizon: expected 1\.\.1000, came 1001"),
    (m.ActionChunk, {"horizon": 0}, r"ActionChunk\.horizon: "),
    (m.ActionChunk, {"action_dim": 257}, r"ActionChunk\.action_dim: expected 1\.\.256, came 257"),
    (m.ActionChunk, {"dt_ns": 0}, r"ActionChunk\.dt_ns: expected > 0, came 0"),
    (m.ActionChunk, {"age_ns": -5}, r"ActionChunk\.age_ns: expected a duration"),
    (m.ActionChunk, {"infer_ns": -5}, r"ActionChunk\.infer_ns: expected a duration"),
    (m.ActionChunk, {"reference_state": NAN}, r"ActionChunk\.reference_state: expected finite"),
    (m.ActionChunk, {"action_space": m.ActionSpace.UNSPECIFIED}, r"ActionChunk\.action_space: "),
    (m.ActionChunk, {"features": bytes((1 << 20) + 1)}, r"ActionChunk\.features: expected at most 1 MiB"),
    (m.Action, {"values": NAN}, r"Action\.values: expected finite numbers"),
    (m.Action, {"values": NO_FLOATS}, r"Action\.values: expected 1\.\.256 numbers"),
    (m.Action, {"level": m.Level.UNSPECIFIED}, r"Action\.level: "),
    (m.Tick, {"state": NAN}, r"Tick\.state: expected finite numbers"),
    (m.Tick, {"action": np.zeros(257, np.float32)}, r"Tick\.action: expected 0\.\.256 numbers"),
    (m.Tick, {"raw_row": np.zeros(257, np.float32)}, r"Tick\.raw_row: "),
    (m.Subgoal, {"token_ids": (0,) * 20_001}, r"Subgoal\.token_ids: expected at most 20000, came 20001"),
    (m.Event, {"severity": m.Severity.UNSPECIFIED}, r"Event\.severity: "),
    (m.Event, {"attributes": {str(i): "" for i in range(257)}}, r"Event\.attributes: expected at most 256 entries"),
    (m.Event, {"attributes": {"k": LONG_TEXT}}, r"Event\.attributes: expected texts of at most 20000"),
    (m.Phase, {"state": LONG_ID}, r"Phase\.state: "),
    (m.Health, {"progress": 1.5}, r"Health\.progress: expected 0\.\.1, came 1\.5"),
    (m.Health, {"progress": float("nan")}, r"Health\.progress: expected 0\.\.1, came nan"),
    (m.Health, {"state": m.ServingState.UNSPECIFIED}, r"Health\.state: "),
    (m.Schedule, {"control_hz": 0}, r"Schedule\.control_hz: expected 1\.\.1000, came 0"),
    (m.Schedule, {"horizon": 0}, r"Schedule\.horizon: "),
    (m.Schedule, {"query_period_ns": 0}, r"Schedule\.query_period_ns: expected > 0"),
    (m.Schedule, {"invoke_period_ticks": 0}, r"Schedule\.invoke_period_ticks: expected >= 1"),
    (m.Schedule, {"mode": m.Mode.UNSPECIFIED}, r"Schedule\.mode: "),
    (m.Schedule, {"query_delay": m.Delay(kind=m.DelayKind.UNSPECIFIED)}, r"Delay\.kind: "),
    (m.Schedule, {"query_delay": m.Delay(kind=m.DelayKind.FIXED, mean_ns=-1)}, r"Delay\.mean_ns: expected a duration"),
    (m.Schedule, {"invoke_delay": m.Delay(kind=m.DelayKind.FIXED, sigma=float("nan"))}, r"Delay\.sigma: "),
    (m.Schedule, {"delivery": m.Delivery(reported_age_ns=-1)}, r"Delivery\.reported_age_ns: expected a duration"),
    (m.Schedule, {"seam": m.Seam(ensemble_decay=-1e9)}, r"Seam\.ensemble_decay: expected -10\.\.10"),
    (m.Schedule, {"seam": m.Seam(ensemble_decay=float("nan"))}, r"Seam\.ensemble_decay: "),
    (m.Robot, {"command_low": ROW + 2}, r"Robot\.command_low: expected <= command_high, came the opposite"),
    (m.Robot, {"command_high": np.zeros(3, np.float32)}, r"Robot\.command_high: expected 2\.\.2 numbers"),
    (m.Robot, {"command_low": NO_FLOATS}, r"Robot\.command_low: expected 1\.\.1 numbers"),
    (m.Robot, {"max_step": ROW - 1}, r"Robot\.max_step: expected >= 0, came a negative step"),
    (m.Robot, {"initial_command": NAN}, r"Robot\.initial_command: expected finite numbers"),
    (m.Robot, {"initial_command": ROW + 2}, r"Robot\.initial_command: expected within command_low and command_high"),
    (m.Robot, {"max_lead": ROW - 1}, r"Robot\.max_lead: expected 2 >= 0"),
    (m.Robot, {"max_lead": ROW[:1]}, r"Robot\.max_lead: expected 2 >= 0"),
    (m.Robot, {"is_simulated": False}, r"Robot\.max_lead: expected 2\.\.2 numbers"),
    (m.Robot, {"is_simulated": False, "max_lead": ROW}, r"Robot\.state_low: expected 2\.\.256 numbers"),
    (m.Robot, {"state_low": ROW}, r"Robot\.state_low: expected <= state_high"),
    (m.Robot, {"state_high": ROW[:1]}, r"Robot\.state_high: expected 2 numbers, came 1"),
    (m.Robot, {"cameras": ("c",) * 9}, r"Robot\.cameras: expected at most 8, came 9"),
    (m.EpisodeInfo, {"header": m.Header(session=LONG_ID)}, r"Header\.session: "),
    (m.EpisodeInfo, {"task": LONG_ID}, r"EpisodeInfo\.task: "),
    (m.EpisodeInfo, {"schedule": with_schedule(control_hz=0)}, r"Schedule\.control_hz: "),
    (m.EpisodeInfo, {"robot": dataclasses.replace(ROBOT, max_step=NAN)}, r"Robot\.max_step: "),
    (m.EpisodeResult, {"status": m.TaskStatus.UNSPECIFIED}, r"EpisodeResult\.status: "),
    (m.OpenRequest, {"info": dataclasses.replace(INFO, suite=LONG_ID)}, r"EpisodeInfo\.suite: "),
    (
        m.OpenRequest,
        {"info": dataclasses.replace(INFO, header=m.Header(episode=LONG_ID))},
        r"Header\.episode: expected at most 128",
    ),
    (m.OpenRequest, {"demo": (m.DemoFrame(images=()),) * 601}, r"OpenRequest\.demo: expected at most 600 instants"),
    (
        m.OpenRequest,
        {"demo": (m.DemoFrame(images=(dataclasses.replace(IMAGE, data=b""),)),)},
        r"Image\.data: expected 12 bytes",
    ),
    (m.OpenReply, {"error": LONG_TEXT}, r"OpenReply\.error: "),
    (m.OpenReply, {"contract": m.Contract(proc=LONG_ID)}, r"Contract\.proc: "),
    (m.OpenReply, {"contracts": (m.Contract(proc="p", infer_p99_ns=-1),)}, r"Contract\.infer_p99_ns: expected a dur"),
    (
        m.CloseRequest,
        {"result": m.EpisodeResult(status=m.TaskStatus.FAIL, is_success=False, reason=LONG_TEXT, num_ticks=0)},
        r"EpisodeResult\.reason: ",
    ),
    (m.Contract, {"demonstrations": m.DemoSampling(hz=3)}, r"Contract\.demonstrations\.hz: expected a divisor of 20"),
    (m.Contract, {"demonstrations": m.DemoSampling(hz=0)}, r"Contract\.demonstrations\.hz: expected a divisor of 20"),
    (m.ContractReply, {"error": LONG_TEXT}, r"ContractReply\.error: "),
    (m.ContractReply, {"contract": m.Contract(proc=LONG_ID)}, r"Contract\.proc: "),
    (m.CloseReply, {"error": LONG_TEXT}, r"CloseReply\.error: "),
    (m.ActiveReply, {"open": m.OpenRequest(info=dataclasses.replace(INFO, task=LONG_ID))}, r"EpisodeInfo\.task: "),
    (m.ActiveReply, {"num_queries": -1}, r"ActiveReply\.num_queries: "),
    (m.JournalRequest, {"max_queries": 65}, r"JournalRequest\.max_queries: expected 1\.\.64, came 65"),
    (m.JournalRequest, {"max_queries": 0}, r"JournalRequest\.max_queries: "),
    (
        m.JournalReply,
        {"entries": (m.JournalEntry(query=0, tick=0, source_ns=0, observation=b""),) * 65},
        r"JournalReply\.entries: expected at most 64, came 65",
    ),
    (
        m.JournalReply,
        {"entries": (m.JournalEntry(query=0, tick=-1, source_ns=0, observation=b""),)},
        r"JournalEntry\.tick: ",
    ),
    (m.TimeRequest, {"t0_ns": 2 * 10**18}, r"TimeRequest\.t0_ns: "),
    (m.TimeReply, {"t2_ns": 0}, r"TimeReply\.t2_ns: expected >= t1_ns 1, came 0"),
    (m.TimeReply, {"clock_id": LONG_ID}, r"TimeReply\.clock_id: "),
    (m.EngageRequest, {"operator": ""}, r"EngageRequest\.operator: expected who says so, came nobody"),
    (m.EngageRequest, {"operator": LONG_ID}, r"EngageRequest\.operator: "),
    (m.EngageReply, {"error": LONG_TEXT}, r"EngageReply\.error: "),
]


def check(message: Any) -> None:
    """As the codec does it; the parts of messages by the function of their own."""
    parts = {
        m.Image: checks.check_image,
        m.Header: checks.check_header,
        m.Schedule: checks.check_schedule,
        m.Robot: checks.check_robot,
        m.Contract: checks.check_contract,
    }
    parts.get(type(message), checks.check)(message)


@pytest.mark.parametrize("cls", GOOD, ids=lambda c: c.__name__)
def test_a_good_message_passes(cls: type) -> None:
    check(GOOD[cls])


@pytest.mark.parametrize(("cls", "change", "sentence"), BROKEN, ids=lambda v: getattr(v, "__name__", None))
def test_a_broken_rule_is_refused_by_name(cls: type, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MalformedMessage, match="^" + sentence):
        check(dataclasses.replace(GOOD[cls], **change))


OF_CHANCE = {"boot_id", "seed"}  # all 64 bits of them


@pytest.mark.parametrize("cls", GOOD, ids=lambda c: c.__name__)
def test_every_number_of_64_bits_is_bounded(cls: type) -> None:
    """So that a sum, a float and a hash of it fit wherever they are made."""
    for field in codec.proto_class(cls).DESCRIPTOR.fields:
        wide = {field.CPPTYPE_UINT64: 2**64 - 1, field.CPPTYPE_INT64: 2**63 - 1}
        if field.cpp_type in wide and not field.is_repeated and field.name not in OF_CHANCE:
            with pytest.raises(MalformedMessage, match=field.name):
                check(dataclasses.replace(GOOD[cls], **{field.name: wide[field.cpp_type]}))


@pytest.mark.parametrize("cls", sorted(checks.CHECKS, key=lambda c: c.__name__), ids=lambda c: c.__name__)
def test_every_checked_message_has_a_broken_example(cls: type) -> None:
    assert cls in {broken for broken, _, _ in BROKEN}


def test_nothing_broken_is_sent() -> None:
    with pytest.raises(MalformedMessage, match=r"Action\.values"):
        codec.encode(dataclasses.replace(GOOD[m.Action], values=NAN))


def test_a_nan_that_the_limits_refused_may_be_told_in_a_tick() -> None:
    check(dataclasses.replace(GOOD[m.Tick], raw_row=NAN))


def test_null_cognition_is_empty_and_of_age_zero() -> None:
    null = np.zeros((0, 0), np.float32)
    check(dataclasses.replace(GOOD[m.Invocation], ref_query=None, age_ns=0, cognition=null))
