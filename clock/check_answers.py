"""Checks queries, stamps, invocations and chunks: which were sent, and when each answer was admitted.

All of it is derived again from the messages and the pure rules (``reference``, ``delays``), without the Conductor, so
that a defect there cannot hide itself. Two facts about its messages are assumed: ``header.at_ns`` of a Query is the
instant of the poll that sent it, and the stamps' ``arrived_ns`` are measurements, which no rule can derive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from clock.check_findings import Disagreement, compare
from clock.conductor import invocation_seed
from clock.delays import in_order, modelled_ns
from clock.dimensions import dimensions_of
from clock.playback import Chunk, covering, deadline_ns, tick_at
from clock.policies import has_ponder
from clock.reference import Ready, latest_ready, refer, text_age_ns
from protocol.mcap_log import EpisodeRecord
from protocol.messages import (
    EPISODE_CLOCK,
    ActionChunk,
    ActionSpace,
    Cognition,
    Floats,
    Invocation,
    Level,
    Mode,
    Query,
    Robot,
    Stamp,
    StampKind,
)

_SKIPPED = {"Query": "query_skipped", "Invocation": "invocation_skipped"}  # events of a server that is away


@dataclass(slots=True)
class Answers:
    """The answers that the clock service took, by index, and the stamps that admitted them."""

    robot: Robot
    cognitions: dict[int, Cognition] = field(default_factory=dict)
    chunks: dict[int, ActionChunk] = field(default_factory=dict)
    ready: list[Ready] = field(default_factory=list)
    chunk_ready_ns: dict[int, int] = field(default_factory=dict)
    first_ticks: dict[int, int] = field(default_factory=dict)  # by chunk: the first tick decided after it was ready

    def admitted(self, now_ns: int) -> list[Chunk]:
        """The chunks that were admitted by ``now_ns``."""
        return [
            Chunk.of(chunk, self.robot, self.first_ticks.get(index))
            for index, chunk in self.chunks.items()
            if index in self.chunk_ready_ns and self.chunk_ready_ns[index] <= now_ns
        ]


def answers_of(record: EpisodeRecord) -> Answers:
    """The answers that the clock service takes: the first to each request; duplicates and unasked ones do not count."""
    asked_ns = {q.query: q.source_ns for q in record.queries}
    invoked_ns = {i.invocation: i.now_ns for i in record.invocations}
    form = (record.info.schedule.horizon, record.info.robot.action_dim, ActionSpace.JOINT_TARGET)
    answers, anchors = Answers(record.info.robot), _anchors(record)
    for cognition in record.cognitions:
        if asked_ns.get(cognition.query) == cognition.source_ns:
            answers.cognitions.setdefault(cognition.query, cognition)
    for chunk in record.chunks:
        came = (chunk.horizon, chunk.action_dim, chunk.action_space)
        reference = chunk.reference_state.tobytes()
        is_anchored = reference in anchors.get(chunk.t_row0, {reference})
        if invoked_ns.get(chunk.invocation) == chunk.source_ns and came == form and is_anchored:
            answers.chunks.setdefault(chunk.invocation, chunk)
    for stamp in record.stamps:
        if stamp.kind == StampKind.CHUNK:
            answers.chunk_ready_ns[stamp.index] = stamp.ready_ns
            decided = (t.tick for t in record.ticks if t.level != Level.SKIPPED and t.decided_ns >= stamp.ready_ns)
            if (first_tick := next(decided, None)) is not None:
                answers.first_ticks[stamp.index] = first_tick
        else:
            answers.ready.append(
                Ready(
                    query=stamp.index,
                    source_ns=stamp.source_ns,
                    ready_ns=stamp.ready_ns,
                    is_transition=stamp.is_transition,
                )
            )
    return answers


def check_queries(record: EpisodeRecord) -> Iterator[Disagreement]:
    """Checks that queries are numbered without gaps, name existing observations, and come once per period.

    In real time at most once: a query may wait for a busy server.
    """
    schedule, queries = record.info.schedule, record.queries
    if queries and not has_ponder(record.info.policy):
        yield from compare("Query", 0, sent=("never: POUNCE plays alone", "once"))
    sources: dict[int, set[int]] = {}
    for observation in record.observations:
        if observation.header.clock_id == EPISODE_CLOCK:  # not comparable on another clock
            sources.setdefault(observation.tick, set()).add(observation.source_ns)
    window = 0
    for index, query in enumerate(queries):
        yield from compare("Query", index, query=(index, query.query))
        if query.tick in sources and query.source_ns not in sources[query.tick]:
            yield from compare("Query", index, source_ns=(min(sources[query.tick]), query.source_ns))
        if index == 0:
            continue
        if query.tick <= queries[index - 1].tick:
            yield from compare("Query", index, tick=(f"later than {queries[index - 1].tick}", query.tick))
        if record.ticks and query.header.clock_id == EPISODE_CLOCK:
            start_ns, hz = record.ticks[0].deadline_ns, schedule.control_hz
            asked_ns = deadline_ns(start_ns, tick_at(start_ns, query.header.at_ns, hz), hz)
            previous, window = window, (asked_ns - queries[0].source_ns) // schedule.query_period_ns
            due_ns = queries[0].source_ns + (previous + 1) * schedule.query_period_ns
            yield from _left_out(record, "Query", index, due_ns, queries[index - 1].tick + 1, before_ns=asked_ns)
            if window <= previous:
                period_ms = schedule.query_period_ns / 1e6
                expected = f"the first of its {period_ms:.0f} ms, period {previous + 1} or later"
                yield from compare("Query", index, period=(expected, f"period {window}"))

    if queries and record.ticks:
        due_ns = queries[0].source_ns + (window + 1) * schedule.query_period_ns
        yield from _left_out(record, "Query", len(queries), due_ns, queries[-1].tick + 1)


def _left_out(
    record: EpisodeRecord, message: str, index: int, due_ns: int, due_tick: int = 0, *, before_ns: int | None = None
) -> Iterator[Disagreement]:
    """Checks, in lockstep, that no tick from ``due_ns`` and ``due_tick`` on was played before a request was made.

    ``before_ns`` is the instant of that request; None if there is none up to the end.

    In real time a request may wait for a busy server, and in both for one that is away, which the log then says.
    """
    is_lockstep = record.info.schedule.mode == Mode.LOCKSTEP
    if not is_lockstep or any(event.name == _SKIPPED[message] for event in record.events):
        return
    start_ns, hz = record.ticks[0].deadline_ns, record.info.schedule.control_hz
    first = max(due_tick, tick_at(start_ns, due_ns - 1, hz) + 1)
    # A request of the last second may have been on its way to the log when the episode ended.
    last = len(record.ticks) - hz if before_ns is None else tick_at(start_ns, before_ns, hz)
    if first < last:
        yield from compare(message, index, sent=(f"at tick {first}", f"at tick {last}" if before_ns else "never"))


def check_stamps(record: EpisodeRecord, answers: Answers) -> Iterator[Disagreement]:
    """Checks that there is one stamp per answer, in order, at the instant of the delay model."""
    schedule = record.info.schedule
    query_rng, invoke_rng = map(np.random.default_rng, np.random.SeedSequence(schedule.seed).spawn(2))
    yield from _check_kind(
        "Stamp of cognition",
        record,
        [s for s in record.stamps if s.kind == StampKind.COGNITION],
        record.queries,
        answers.cognitions,
        [modelled_ns(schedule.query_delay, query_rng) for _ in record.queries],
    )
    yield from _check_kind(
        "Stamp of chunk",
        record,
        [s for s in record.stamps if s.kind == StampKind.CHUNK],
        record.invocations,
        answers.chunks,
        [modelled_ns(schedule.invoke_delay, invoke_rng) for _ in record.invocations],
    )


def _check_kind(
    name: str,
    record: EpisodeRecord,
    stamps: Sequence[Stamp],
    asked: Sequence[Query] | Sequence[Invocation],
    answers: dict[int, Cognition] | dict[int, ActionChunk],
    delays_ns: Sequence[int | None],
) -> Iterator[Disagreement]:
    is_lockstep = record.info.schedule.mode == Mode.LOCKSTEP
    last_index, last_ready_ns, seen = -1, None, set[int]()
    for stamp in stamps:
        if stamp.index in seen:
            yield from compare(name, stamp.index, times=("stamped once", "twice"))
        if is_lockstep and stamp.index < last_index:  # in real time an overdue answer may follow a later one
            yield from compare(name, stamp.index, order=("before the later ones", f"after {last_index}"))
        seen.add(stamp.index)
        answer = answers.get(stamp.index)
        if stamp.index >= len(asked) or answer is None:
            yield from compare(name, stamp.index, answer=("the answer it admits", "none in the log"))
            continue
        delay_ns = delays_ns[stamp.index]
        if delay_ns is None:  # measured: compute time (lockstep) or arrival (real time)
            delay_ns = answer.infer_ns if is_lockstep else stamp.arrived_ns - answer.source_ns
        due_ns = answer.source_ns + delay_ns
        ready_ns = in_order(due_ns if is_lockstep else max(due_ns, stamp.arrived_ns), last_ready_ns)
        is_transition = isinstance(answer, Cognition) and answer.is_transition
        yield from compare(
            name,
            stamp.index,
            source_ns=(answer.source_ns, stamp.source_ns),
            ready_ns=(ready_ns, stamp.ready_ns),
            is_transition=(is_transition, stamp.is_transition),
        )
        last_index, last_ready_ns = stamp.index, stamp.ready_ns


def check_invocations(record: EpisodeRecord, answers: Answers) -> Iterator[Disagreement]:
    """Checks the paper's rule: reference and age of every invocation, the vector it contains, and its chunk's copy."""
    window, first_tick = -1, _first_tick(record)
    most_committed = max((each.committed_rows for each in record.invocations), default=0)
    for index, invocation in enumerate(record.invocations):
        yield from _check_given(record, answers, index, invocation)
        if record.ticks and (tick := _tick_of(record, invocation)) >= 0:
            due_ns = deadline_ns(record.ticks[0].deadline_ns, tick, record.info.schedule.control_hz)
            yield from compare("Invocation", index, now_ns=(due_ns, invocation.now_ns))
            period = record.info.schedule.invoke_period_ticks
            previous, window = window, (tick - first_tick) // period
            if index:
                after = _tick_of(record, record.invocations[index - 1])
                yield from _left_out(
                    record, "Invocation", index, _invocation_due_ns(record, after), before_ns=invocation.now_ns
                )
            if window <= previous:
                expected = f"the first of its {period} ticks, period {previous + 1} or later"
                yield from compare("Invocation", index, period=(expected, f"period {window}"))
            tail = _unplayed_rows(record, answers, tick, index)
            if tail is not None:
                committed = min(most_committed, len(tail) // record.info.robot.action_dim)
                yield from compare(
                    "Invocation",
                    index,
                    previous_rows=(tail, invocation.previous_rows),
                    committed_rows=(committed, invocation.committed_rows),
                )
        chunk = answers.chunks.get(index)
        if chunk is not None and index in answers.chunk_ready_ns:
            yield from compare(
                "ActionChunk",
                index,
                t_row0=(invocation.tick, chunk.t_row0),
                ref_query=(invocation.ref_query, chunk.ref_query),
                age_ns=(invocation.age_ns, chunk.age_ns),
                seed=(invocation.seed, chunk.seed),
            )
    if record.invocations and record.ticks:
        due_ns = _invocation_due_ns(record, _tick_of(record, record.invocations[-1]))
        yield from _left_out(record, "Invocation", len(record.invocations), due_ns)


def _anchors(record: EpisodeRecord) -> dict[int, set[bytes]]:
    """States by tick, to which increments may be added; empty for a robot without increments."""
    found: dict[int, set[bytes]] = {}
    if len(dimensions_of(record.info.robot).deltas):
        for observation in record.observations:
            found.setdefault(observation.tick, set()).add(observation.proprio.tobytes())
    return found


def _check_given(record: EpisodeRecord, answers: Answers, index: int, invocation: Invocation) -> Iterator[Disagreement]:
    """Checks reference, age, vector and noise seed against the stamps admitted when the invocation was made."""
    schedule = record.info.schedule
    polled_ns = _polled_ns(record, invocation)
    admitted = [ready for ready in answers.ready if ready.ready_ns <= polled_ns]
    reference = refer(admitted, invocation.now_ns, schedule.delivery)
    yield from compare(
        "Invocation",
        index,
        invocation=(index, invocation.invocation),
        ref_query=(reference.query, invocation.ref_query),
        age_ns=(reference.age_ns, invocation.age_ns),
        seed=(invocation_seed(schedule.seed, index), invocation.seed),
    )
    if latest_ready(admitted, invocation.now_ns) is None and has_ponder(record.info.policy):
        yield from compare("Invocation", index, now_ns=("after the first cognition", invocation.now_ns))
    if reference.query is None:
        none = ((0, 0), None, 0)
        came = (invocation.cognition.shape, invocation.text, invocation.text_age_ns)
        yield from compare("Invocation", index, cognition=(none, came))
    elif reference.query in answers.cognitions:
        given = answers.cognitions[reference.query]
        yield from compare(
            "Invocation",
            index,
            cognition=(given.vector, invocation.cognition),
            text=(given.text, invocation.text),
            text_age_ns=(text_age_ns(given, invocation.now_ns), invocation.text_age_ns),
        )


def _first_tick(record: EpisodeRecord) -> int:
    """The tick of the first invocation, from which the period counts."""
    return max(0, _tick_of(record, record.invocations[0])) if record.ticks and record.invocations else 0


def _invocation_due_ns(record: EpisodeRecord, after: int) -> int:
    """When the next invocation is due after one at this tick; the opening's, before tick 0, counts as tick 0's."""
    period, first = record.info.schedule.invoke_period_ticks, _first_tick(record)
    due = first + ((max(after, first) - first) // period + 1) * period
    return deadline_ns(record.ticks[0].deadline_ns, due, record.info.schedule.control_hz)


def _tick_of(record: EpisodeRecord, invocation: Invocation) -> int:
    """The tick at whose deadline the invocation was made; negative before tick 0, when it is made immediately."""
    return tick_at(record.ticks[0].deadline_ns, invocation.now_ns, record.info.schedule.control_hz)


def _polled_ns(record: EpisodeRecord, invocation: Invocation) -> int:
    """The instant of the poll that made this invocation: its tick may have been decided late."""
    if not record.ticks:
        return invocation.now_ns
    tick = _tick_of(record, invocation)
    return record.ticks[tick].decided_ns if 0 <= tick < len(record.ticks) else invocation.now_ns


def _unplayed_rows(record: EpisodeRecord, answers: Answers, tick: int, invocation: int) -> Floats | None:
    """Unplayed rows of the chunk in use from ``tick`` on, (n * action_dim,); None if the log ends before.

    Only earlier invocations count: with a modelled delay of 0 a chunk is admitted at its invocation's own instant.
    """
    if tick >= len(record.ticks) or record.ticks[tick].level == Level.SKIPPED:
        return None
    admitted = answers.admitted(record.ticks[tick].decided_ns)
    chunks = covering([c for c in admitted if c.invocation < invocation], tick)
    return chunks[-1].given_from(tick).ravel() if chunks else np.zeros(0, np.float32)
