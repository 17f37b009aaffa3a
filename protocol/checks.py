"""Checks of a decoded message before any other code uses it: shapes, finiteness, size caps.

Each check is pure and raises ``MalformedMessage`` with the expected and the actual value. The caps bound the memory
that an untrusted peer can make us allocate; they are far above any real model's messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from protocol import messages as m
from protocol.errors import MalformedMessage
from protocol.robot_checks import MAX_CAMERAS, MAX_CONTROL_HZ, MAX_NAME, faults
from protocol.window_checks import no_window

MAX_MESSAGE_BYTES = 64 << 20  # an OpenRequest with a 48 s demonstration of two raw 256 px views is 19 MB
MAX_PLAIN_MESSAGE_BYTES = 4 << 20  # without pictures; two bytes of protobuf can become a hundred in memory
MAX_IMAGES = MAX_CAMERAS
MAX_IMAGE_SIDE_PX = 4096
MAX_CARRIERS = 64
MAX_HIDDEN = 65_536
MAX_HORIZON = 1_000
MAX_DIM = 256
MAX_TEXT = 20_000
MAX_ID = MAX_NAME
MAX_INSTANT_NS = 10**18  # 31 years: more is a unit mistake
MAX_UNIX_NS = 2**62  # the year 2116
MAX_INDEX = 2**53
MAX_DEMO_FRAMES = 600
MAX_MEMBERS = 16
MAX_CHANNELS = 8
DEMO_VIDEO_HZ = 20
MAX_DECAY = 10  # per chunk: exp(-10) is negligible
MAX_JOURNAL_ENTRIES = 64


def _broken(message: object, field: str, expected: str, came: object) -> MalformedMessage:
    return MalformedMessage(type(message).__name__, field, expected, str(came))


def _require(ok: bool, message: object, field: str, expected: str, came: object) -> None:
    if not ok:
        raise _broken(message, field, expected, came)


# The following checks run a dozen times per message on the control path: they format a message only on failure.


def _index(message: Any, *names: str) -> None:
    for name in names:
        value = getattr(message, name)
        if not 0 <= value <= MAX_INDEX:
            raise _broken(message, name, f"0..{MAX_INDEX}", value)


def _ordinal(message: Any, *names: str) -> None:
    """Numbers that count on from here: the next one must be an index as well."""
    for name in names:
        value = getattr(message, name)
        if not 0 <= value < MAX_INDEX:
            raise _broken(message, name, f"0..{MAX_INDEX - 1}", value)


def _reference(message: Any, *names: str) -> None:
    """Indices of another message, or none."""
    for name in names:
        if getattr(message, name) is not None:
            _index(message, name)


def _instant(message: Any, *names: str) -> None:
    for name in names:
        value = getattr(message, name)
        if abs(value) > MAX_INSTANT_NS:
            raise _broken(message, name, "nanoseconds within 31 years", value)


def _anchor(message: Any, *names: str) -> None:
    """Instants from which others count on: what they come to must be an instant as well."""
    for name in names:
        value = getattr(message, name)
        if abs(value) > MAX_INSTANT_NS // 2:
            raise _broken(message, name, "nanoseconds within 15 years", value)


def _duration(message: Any, *names: str) -> None:
    for name in names:
        value = getattr(message, name)
        if not 0 <= value <= MAX_INSTANT_NS:
            raise _broken(message, name, "a duration within 31 years", value)


def _vector(message: Any, name: str, *, low: int = 0, high: int = MAX_DIM) -> None:
    value = getattr(message, name)
    if value.ndim != 1 or not low <= value.size <= high:
        raise _broken(message, name, f"{low}..{high} numbers", value.shape)
    if not _are_finite(value):
        raise _broken(message, name, "finite numbers", "NaN or infinity")


def _are_finite(values: m.Floats) -> bool:
    """``np.isfinite(values).all()`` in one call, unless the sum of squares overflows or is NaN."""
    return not values.size or math.isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all())


def _carriers(message: Any, name: str, *, may_be_empty: bool) -> None:
    value = getattr(message, name)
    if may_be_empty and value.size == 0:
        return
    good = value.ndim == 2 and 1 <= value.shape[0] <= MAX_CARRIERS and 1 <= value.shape[1] <= MAX_HIDDEN
    _require(good, message, name, f"(K <= {MAX_CARRIERS}, H <= {MAX_HIDDEN})", value.shape)
    _require(_are_finite(value), message, name, "finite numbers", "NaN or infinity")


def _text(message: Any, *names: str, limit: int = MAX_TEXT) -> None:
    for name in names:
        value = getattr(message, name)
        if len(value) > limit:
            raise _broken(message, name, f"at most {limit} characters", len(value))


def _spoken(message: Any, instant: str) -> None:
    """A subgoal in force, and when it was written: 0 without one."""
    if message.text is not None:
        _text(message, "text")
    _require(bool(message.text) or not getattr(message, instant), message, instant, "0 without a text", "a number")


def _members(message: Any, members: tuple[m.Member, ...]) -> None:
    _require(len(members) <= MAX_MEMBERS, message, "members", f"at most {MAX_MEMBERS}", len(members))
    for member in members:
        _text(member, "proc", limit=MAX_ID)


def _chosen(message: Any, *names: str) -> None:
    for name in names:
        if not getattr(message, name):
            raise _broken(message, name, "a specified value", "UNSPECIFIED")


def _map(message: Any, name: str) -> None:
    value = getattr(message, name)
    _require(len(value) <= 256, message, name, "at most 256 entries", len(value))
    longest = max((max(len(k), len(str(v))) for k, v in value.items()), default=0)
    _require(longest <= MAX_TEXT, message, name, f"texts of at most {MAX_TEXT} characters", longest)


def _images(message: Any, images: tuple[m.Image, ...]) -> None:
    if len(images) > MAX_IMAGES:
        raise _broken(message, "images", f"at most {MAX_IMAGES}", len(images))
    for image in images:
        check_image(image)


def check_image(i: m.Image) -> None:
    _text(i, "camera", limit=MAX_ID)
    if not (1 <= i.height <= MAX_IMAGE_SIDE_PX and 1 <= i.width <= MAX_IMAGE_SIDE_PX):
        raise _broken(i, "height, width", f"1..{MAX_IMAGE_SIDE_PX} px", (i.height, i.width))
    raw_bytes = i.height * i.width * 3
    if i.codec == m.ImageCodec.RAW:
        if len(i.data) != raw_bytes:
            raise _broken(i, "data", f"{raw_bytes} bytes of RGB", len(i.data))
        return
    _chosen(i, "codec")
    if i.codec == m.ImageCodec.ELSEWHERE:
        _require(len(i.data) == 0, i, "data", "no bytes", len(i.data))
    else:
        _require(0 < len(i.data) <= 2 * raw_bytes + 4096, i, "data", "a compressed image", f"{len(i.data)} bytes")


def check_header(h: m.Header) -> None:
    _text(h, "robot", "session", "episode", "proc", "clock_id", limit=MAX_ID)
    _index(h, "seq", "epoch")
    _instant(h, "at_ns")


def check_observation(o: m.Observation) -> None:
    _ordinal(o, "tick")
    _instant(o, "source_ns")
    _vector(o, "proprio", low=1)
    _chosen(o, "status")
    _text(o, "reason", "robot_text")
    _images(o, o.images)
    if o.captured_ns:
        _require(len(o.captured_ns) == len(o.images), o, "captured_ns", f"{len(o.images)} instants", len(o.captured_ns))
        _require(max(map(abs, o.captured_ns)) <= MAX_INSTANT_NS, o, "captured_ns", "within 31 years", o.captured_ns)


def check_query(q: m.Query) -> None:
    _ordinal(q, "query", "tick")
    _instant(q, "source_ns")


def check_cognition(c: m.Cognition) -> None:
    _ordinal(c, "query", "tick")
    _index(c, "context_tokens")
    _instant(c, "source_ns", "ready_ns")
    _duration(c, "infer_ns")
    _carriers(c, "vector", may_be_empty=c.text is not None)
    _text(c, "model_hash", limit=MAX_ID)
    if c.gate_score is not None:
        _require(math.isfinite(c.gate_score), c, "gate_score", "a finite number, or none", c.gate_score)
    _spoken(c, "text_source_ns")
    written_ns = c.text_source_ns if c.text else c.source_ns
    _require(0 <= c.source_ns - written_ns <= MAX_INSTANT_NS, c, "text_source_ns", f"<= {c.source_ns}", written_ns)


def check_stamp(s: m.Stamp) -> None:
    _chosen(s, "kind")
    _index(s, "index")
    _instant(s, "source_ns", "ready_ns", "arrived_ns")
    _require(s.ready_ns >= s.source_ns, s, "ready_ns", f">= source_ns {s.source_ns}", s.ready_ns)


def check_invocation(i: m.Invocation) -> None:
    _ordinal(i, "invocation", "tick")
    _index(i, "committed_rows", "num_samples")
    _reference(i, "ref_query")
    _instant(i, "now_ns")
    _duration(i, "age_ns")
    _carriers(i, "cognition", may_be_empty=True)
    is_null, is_text = i.ref_query is None, i.text is not None
    _require(
        not is_null or (i.age_ns == 0 and i.cognition.size == 0),
        i,
        "age_ns",
        "0 for null cognition",
        i.age_ns,
    )
    _require(not (is_null and is_text), i, "text", "nothing for null cognition", "a text")
    _require(is_null or is_text or i.cognition.size > 0, i, "cognition", "the vector of ref_query", "nothing")
    _spoken(i, "text_age_ns")
    _duration(i, "text_age_ns")
    _vector(i, "previous_rows", high=MAX_HORIZON * MAX_DIM)


def check_action_chunk(c: m.ActionChunk) -> None:
    _ordinal(c, "invocation", "t_row0")
    _index(c, "committed_rows")
    _reference(c, "ref_query")
    _instant(c, "source_ns")
    _duration(c, "age_ns", "infer_ns", "dt_ns")
    if not 1 <= c.horizon <= MAX_HORIZON:
        raise _broken(c, "horizon", f"1..{MAX_HORIZON}", c.horizon)
    if not 1 <= c.action_dim <= MAX_DIM:
        raise _broken(c, "action_dim", f"1..{MAX_DIM}", c.action_dim)
    _require(c.dt_ns > 0, c, "dt_ns", "> 0", c.dt_ns)
    size = c.horizon * c.action_dim
    _vector(c, "rows", low=size, high=size)
    _vector(c, "reference_state")
    _vector(c, "previous_rows", high=MAX_HORIZON * MAX_DIM)
    for name in ("padded_video_ticks", "padded_state_ticks"):
        if why_not := no_window((*getattr(c, name), 0)):
            raise _broken(c, name, "offsets of past ticks", why_not)
    _chosen(c, "action_space")
    _require(len(c.features) <= 1 << 20, c, "features", "at most 1 MiB", len(c.features))
    _text(c, "model_hash", limit=MAX_ID)


def check_action(a: m.Action) -> None:
    _ordinal(a, "tick")
    _anchor(a, "deadline_ns")
    _chosen(a, "level")
    _vector(a, "values", low=1)


def check_tick(t: m.Tick) -> None:
    _index(t, "tick", "t_row0", "row", "observation_tick")
    _reference(t, "invocation", "ref_query")
    _anchor(t, "deadline_ns")
    _instant(t, "decided_ns", "late_ns", "age_ns")
    _chosen(t, "level")
    for name in ("state", "action"):
        _vector(t, name)
    # raw_row may hold a NaN that the limits refused: it is logged, not commanded.
    _require(
        t.raw_row.ndim == 1 and len(t.raw_row) <= MAX_DIM,
        t,
        "raw_row",
        f"0..{MAX_DIM} numbers",
        t.raw_row.shape,
    )
    for name in ("picture_age_ns", "picture_still_ns"):
        _require(len(getattr(t, name)) <= MAX_IMAGES, t, name, f"at most {MAX_IMAGES}", len(getattr(t, name)))


def check_subgoal(s: m.Subgoal) -> None:  # of any kind, because an unknown kind is only logged
    _text(s, "text")
    _index(s, "tick")
    _reference(s, "query")
    _require(len(s.token_ids) <= MAX_TEXT, s, "token_ids", f"at most {MAX_TEXT}", len(s.token_ids))


def check_event(e: m.Event) -> None:
    _chosen(e, "severity")
    _text(e, "name", limit=MAX_ID)
    _text(e, "text")
    _index(e, "tick")
    _map(e, "attributes")


def check_phase(p: m.Phase) -> None:
    _text(p, "state", limit=MAX_ID)


def check_health(h: m.Health) -> None:
    _chosen(h, "state")
    _require(0.0 <= h.progress <= 1.0, h, "progress", "0..1", h.progress)
    _text(h, "detail", "version")
    _text(h, "open_episode", "model_hash", limit=MAX_ID)
    _index(h, "next_index", "num_answered")
    _instant(h, "infer_p50_ns", "infer_p99_ns")
    _map(h, "dropped")


def check_schedule(s: m.Schedule) -> None:
    _chosen(s, "mode", "wait")
    _require(1 <= s.control_hz <= 1000, s, "control_hz", "1..1000", s.control_hz)
    _require(1 <= s.horizon <= MAX_HORIZON, s, "horizon", f"1..{MAX_HORIZON}", s.horizon)
    _duration(s, "query_period_ns")
    _require(s.query_period_ns > 0, s, "query_period_ns", "> 0", s.query_period_ns)
    _require(s.invoke_period_ticks >= 1, s, "invoke_period_ticks", ">= 1", s.invoke_period_ticks)
    for delay in (s.query_delay, s.invoke_delay):
        _chosen(delay, "kind")
        _duration(delay, "mean_ns")
        _require(0 <= delay.sigma <= 3, delay, "sigma", "0..3", delay.sigma)
    _chosen(s.delivery, "kind")
    _duration(s.delivery, "reported_age_ns")
    _chosen(s.seam, "kind")
    decay = s.seam.ensemble_decay
    _require(abs(decay) <= MAX_DECAY, s.seam, "ensemble_decay", f"-{MAX_DECAY}..{MAX_DECAY}", decay)
    _instant(s, "max_age_ns", "stale_limit_ns")
    _index(s, "hold_limit_ticks", "decelerate_ticks", "max_ticks")


def check_robot(r: m.Robot) -> None:
    dim = len(r.command_low)
    for name in ("command_low", "command_high", "max_step", "initial_command"):
        _vector(r, name, low=max(dim, 1), high=max(dim, 1))
    _vector(r, "max_lead", low=0 if r.is_simulated else dim, high=dim)
    for name in ("state_low", "state_high"):
        _vector(r, name, low=0 if r.is_simulated else r.num_proprio)
        size = len(getattr(r, name))
        _require(size in (0, r.num_proprio), r, name, f"{r.num_proprio} numbers", size)
    _index(r, "image_height", "image_width", "num_proprio", "stop_ticks")
    for field, expected, came in faults(r):
        raise _broken(r, field, expected, came)


def check_episode_info(e: m.EpisodeInfo) -> None:
    check_header(e.header)
    _text(e, "task", "suite", "difficulty", "policy", limit=MAX_ID)
    _text(e, "instruction")
    check_schedule(e.schedule)
    check_robot(e.robot)
    _require(0 <= e.t0_unix_ns <= MAX_UNIX_NS, e, "t0_unix_ns", f"0..{MAX_UNIX_NS}", e.t0_unix_ns)
    rate_hz, robot_hz = e.schedule.control_hz, e.robot.control_hz
    _require(robot_hz in (0, rate_hz), e, "schedule.control_hz", f"{robot_hz}, the robot's control_hz", rate_hz)
    _map(e, "versions")


def check_episode_result(r: m.EpisodeResult) -> None:
    _chosen(r, "status")
    _text(r, "reason")
    _index(r, "num_ticks")
    _text(r, "stream_sha256", limit=MAX_ID)
    _map(r, "statistics")


def check_open_request(r: m.OpenRequest) -> None:
    check_episode_info(r.info)
    _require(len(r.demo) <= MAX_DEMO_FRAMES, r, "demo", f"at most {MAX_DEMO_FRAMES} instants", len(r.demo))
    for frame in r.demo:
        _images(frame, frame.images)
    _members(r, r.members)


def check_contract(c: m.Contract) -> None:
    _text(c, "proc", "model_hash", "version", limit=MAX_ID)
    _duration(c, "infer_p50_ns", "infer_p99_ns")
    _require(len(c.channels) <= MAX_CHANNELS, c, "channels", f"at most {MAX_CHANNELS}", len(c.channels))
    _require(0 <= c.control_hz <= MAX_CONTROL_HZ, c, "control_hz", f"0..{MAX_CONTROL_HZ}", c.control_hz)
    for name in ("video_ticks", "state_ticks") if c.window is not None else ():
        if why_not := no_window(getattr(c.window, name)):
            raise _broken(c, f"window.{name}", "offsets of a window", why_not)
    if c.demonstrations is not None:
        hz = c.demonstrations.hz
        _require(hz > 0 and DEMO_VIDEO_HZ % hz == 0, c, "demonstrations.hz", f"a divisor of {DEMO_VIDEO_HZ}", hz)


def check_contract_reply(r: m.ContractReply) -> None:
    _text(r, "error")
    if r.contract is not None:
        check_contract(r.contract)


def check_open_reply(r: m.OpenReply) -> None:
    _text(r, "error")
    for contract in (r.contract, *r.contracts):
        if contract is not None:
            check_contract(contract)
    _members(r, r.members)
    longest = max(map(len, r.warnings), default=0)
    _require(longest <= MAX_TEXT, r, "warnings", f"texts of at most {MAX_TEXT} characters", longest)


def check_close_request(r: m.CloseRequest) -> None:
    if r.result is not None:
        check(r.result)


def check_active_reply(r: m.ActiveReply) -> None:
    _text(r, "error")
    _index(r, "num_queries")
    _reference(r, "owed_query")
    if r.open is not None:
        check_open_request(r.open)


def check_journal_request(r: m.JournalRequest) -> None:
    _index(r, "first_query")
    _require(1 <= r.max_queries <= MAX_JOURNAL_ENTRIES, r, "max_queries", f"1..{MAX_JOURNAL_ENTRIES}", r.max_queries)


def check_journal_reply(r: m.JournalReply) -> None:
    _text(r, "error")
    _require(len(r.entries) <= MAX_JOURNAL_ENTRIES, r, "entries", f"at most {MAX_JOURNAL_ENTRIES}", len(r.entries))
    for entry in r.entries:
        _ordinal(entry, "query", "tick")
        _instant(entry, "source_ns")


def check_time_request(r: m.TimeRequest) -> None:
    _instant(r, "t0_ns")


def check_time_reply(r: m.TimeReply) -> None:
    _text(r, "error")
    _text(r, "clock_id", limit=MAX_ID)
    _instant(r, "t1_ns", "t2_ns")
    _require(r.t1_ns <= r.t2_ns, r, "t2_ns", f">= t1_ns {r.t1_ns}", r.t2_ns)


def check_engage_request(r: m.EngageRequest) -> None:
    _require(bool(r.operator), r, "operator", "who says so", "nobody")  # proto3 reads zero bytes as a request
    _text(r, "operator", limit=MAX_ID)


def check_error_reply(r: Any) -> None:
    _text(r, "error")


def check_engage_reply(r: m.EngageReply) -> None:
    _text(r, "error")
    _text(r, "level", limit=MAX_ID)


CHECKS: dict[type, Callable[[Any], None]] = {
    m.Observation: check_observation,
    m.Query: check_query,
    m.Cognition: check_cognition,
    m.Stamp: check_stamp,
    m.Invocation: check_invocation,
    m.ActionChunk: check_action_chunk,
    m.Action: check_action,
    m.Tick: check_tick,
    m.Subgoal: check_subgoal,
    m.Event: check_event,
    m.Phase: check_phase,
    m.Health: check_health,
    m.EpisodeInfo: check_episode_info,
    m.EpisodeResult: check_episode_result,
    m.OpenRequest: check_open_request,
    m.OpenReply: check_open_reply,
    m.ContractReply: check_contract_reply,
    m.CloseRequest: check_close_request,
    m.CloseReply: check_error_reply,
    m.ActiveReply: check_active_reply,
    m.JournalRequest: check_journal_request,
    m.JournalReply: check_journal_reply,
    m.TimeRequest: check_time_request,
    m.TimeReply: check_time_reply,
    m.EngageRequest: check_engage_request,
    m.EngageReply: check_engage_reply,
}


def check(message: Any) -> None:
    """Raises MalformedMessage if ``message`` breaks a rule."""
    header = getattr(message, "header", None)
    if header is not None:
        check_header(header)
    checker = CHECKS.get(type(message))
    if checker is not None:
        checker(message)
