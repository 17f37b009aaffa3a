"""A log that the Conductor wrote agrees with itself, however the answers jitter; one wrong bit and it does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.check import check_result, disagreements, main
from clock.check_answers import answers_of, check_invocations, check_queries
from clock.report import stream_sha256
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log

MS = 1_000_000
MEASURED = m.Delay(kind=m.DelayKind.MEASURED)
NO_DELAY = m.Delay(kind=m.DelayKind.FIXED, mean_ns=0)
DELAYS = [
    MEASURED,
    NO_DELAY,
    m.Delay(kind=m.DelayKind.FIXED, mean_ns=300 * MS),
    m.Delay(kind=m.DelayKind.LOG_NORMAL, mean_ns=200 * MS, sigma=0.6),
]
SCHEDULES = st.fixed_dictionaries(
    {
        "query_period_ns": st.integers(1, 12).map(lambda ticks: ticks * 50 * MS),
        "invoke_period_ticks": st.integers(1, 12),
        "query_delay": st.sampled_from(DELAYS),
        "invoke_delay": st.sampled_from(DELAYS),
        "wait": st.sampled_from([m.WaitKind.STAND_STILL, m.WaitKind.HOLD]),
        "seam": st.sampled_from(
            [
                m.Seam(),
                m.Seam(kind=m.SeamKind.OFFSET_FADE, fade_ticks=4),
                m.Seam(kind=m.SeamKind.ENSEMBLE, ensemble_decay=0.1),
            ]
        ),
        "delivery": st.sampled_from(
            [
                m.Delivery(),
                m.Delivery(kind=m.DeliveryKind.HELD_TRANSITION),
                m.Delivery(kind=m.DeliveryKind.HELD_TRANSITION, reported_age_ns=300 * MS),
                m.Delivery(kind=m.DeliveryKind.NULL),
            ]
        ),
        "seed": st.integers(0, 2**63),
    }
)


@pytest.fixture(scope="module")
def record_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Any], EpisodeRecord]:
    """An episode as it comes back from a file."""

    def saved(episode: Any) -> EpisodeRecord:
        return read_log(episode.save(tmp_path_factory.mktemp("log") / "episode.mcap"))

    return saved


@pytest.fixture(scope="module")
def good(timing: Any, lockstep: Any, record_of: Any) -> EpisodeRecord:
    record = record_of(lockstep(timing(), 60, seed=3))
    assert next(disagreements(record), None) is None
    return record


@settings(max_examples=25, deadline=None)
@given(changes=SCHEDULES, seed=st.integers(0, 2**32))
def test_lockstep_agrees_in_whatever_order_answers_come(
    changes: Any, seed: int, timing: Any, lockstep: Any, record_of: Any
) -> None:
    record = record_of(lockstep(timing(**changes), 40, seed))
    assert len(record.ticks) == 40
    assert list(disagreements(record)) == []


def test_a_cognition_without_delay_is_seen_by_the_invocation_of_the_same_tick(
    timing: Any, lockstep: Any, record_of: Any
) -> None:
    record = record_of(lockstep(timing(query_delay=NO_DELAY, invoke_period_ticks=1), 20, seed=0))
    assert {i.age_ns for i in record.invocations if i.tick in {q.tick for q in record.queries}} == {0}
    assert list(disagreements(record)) == []


@settings(max_examples=25, deadline=None)
@given(changes=SCHEDULES, seed=st.integers(0, 2**32), stalls=st.sampled_from([0.0, 0.03, 0.3]))
def test_real_time_agrees_however_late_everybody_is(
    changes: Any, seed: int, stalls: float, timing: Any, realtime: Any, record_of: Any
) -> None:
    record = record_of(realtime(timing(**changes), 60, seed, stalls=stalls))
    assert list(disagreements(record)) == []


@settings(max_examples=15, deadline=None)
@given(changes=SCHEDULES, seed=st.integers(0, 2**32), is_live=st.booleans())
def test_pounce_alone_agrees_and_reads_null_from_the_first_observation_on(
    changes: Any, seed: int, is_live: bool, timing: Any, lockstep: Any, realtime: Any, record_of: Any
) -> None:
    record = record_of((realtime if is_live else lockstep)(timing(**changes), 40, seed, policy="pounce"))
    assert list(disagreements(record)) == []
    assert record.queries == []
    assert {(each.ref_query, each.age_ns, each.text) for each in record.invocations} == {(None, 0, None)}
    assert m.Level.STALE not in {tick.level for tick in record.ticks}
    asked = replace(record, queries=[m.Query(query=0, tick=0, source_ns=0)])
    assert "never: POUNCE plays alone" in str(next(disagreements(asked)))


def test_a_subgoal_of_another_query_or_age_is_found(good: EpisodeRecord) -> None:
    index = next(i for i, each in enumerate(good.invocations) if each.text_age_ns)
    for field, value in (("text", "another"), ("text", None), ("text_age_ns", 1)):
        forged = list(good.invocations)
        forged[index] = replace(forged[index], **{field: value})
        found = next(check_invocations(replace(good, invocations=forged), answers_of(good)))
        assert (found.message, found.index, found.field) == ("Invocation", index, field)


def test_lockstep_is_the_same_in_whatever_order_answers_come(timing: Any, lockstep: Any, record_of: Any) -> None:
    hashes = set()
    for order in range(4):
        episode = lockstep(timing(delivery=m.Delivery(kind=m.DeliveryKind.NULL)), 40, seed=order)
        hashes.add(tuple((t.tick, t.deadline_ns, t.invocation, t.age_ns) for t in record_of(episode).ticks))
    assert len(hashes) == 1


def test_a_silent_server_stops_the_robot_and_engage_starts_it(timing: Any, realtime: Any, record_of: Any) -> None:
    timed = timing(query_delay=MEASURED, invoke_delay=MEASURED)
    record = record_of(realtime(timed, 120, seed=5, stalls=0.0, silence=range(6, 10)))
    levels = [t.level for t in record.ticks]
    assert {m.Level.HOLD, m.Level.DECELERATE, m.Level.STOPPED} < set(levels)
    assert m.Level.PLAY in levels[levels.index(m.Level.STOPPED) :]
    assert list(disagreements(record)) == []

    forgotten = replace(record, events=[e for e in record.events if e.name != "engaged"])
    found = next(disagreements(forgotten))
    assert (found.message, found.field) == ("Tick", "level")


def test_a_stalled_clock_skips_ticks_and_says_so(timing: Any, realtime: Any, record_of: Any) -> None:
    timed = timing(query_delay=MEASURED, invoke_delay=MEASURED)
    record = record_of(realtime(timed, 80, seed=1, stalls=0.2))
    skipped = next(t for t in record.ticks if t.level == m.Level.SKIPPED)
    assert list(disagreements(record)) == []
    hidden = changed(record, "ticks", skipped.tick, level=m.Level.HOLD)
    found = next(disagreements(hidden))
    assert (found.message, found.index, found.field) == ("Tick", skipped.tick, "is_skipped")


@pytest.mark.parametrize(("num_missing", "is_lost", "agrees"), [(1, True, True), (2, True, False), (1, False, False)])
def test_of_a_clock_that_was_killed_the_last_account_may_be_missing(
    num_missing: int, is_lost: bool, agrees: bool, timing: Any, realtime: Any, record_of: Any
) -> None:
    """It died after the action, which the robot obeyed and counts. The hash is over what was told."""
    record = record_of(realtime(timing(), 40, seed=2))
    assert record.result is not None
    told = record.ticks[: record.result.num_ticks - num_missing]
    lost = m.Event(severity=m.Severity.ERROR, name="clock_lost", text="no command for 600 ms")
    killed = replace(
        record,
        ticks=told,
        events=[*record.events, *([lost] if is_lost else [])],
        result=replace(record.result, stream_sha256=stream_sha256(told)),
    )
    found = list(check_result(killed))
    assert not found if agrees else [each.field for each in found] == ["num_ticks"]


@pytest.mark.parametrize("has_left", [True, False])
def test_only_a_last_tick_after_the_robot_left_may_lack_its_action(
    has_left: bool, timing: Any, realtime: Any, record_of: Any
) -> None:
    record = record_of(realtime(timing(), 40, seed=2))
    last = record.ticks[-1].tick
    num_ticks = last if has_left else last + 1
    result = replace(record.result, num_ticks=num_ticks, stream_sha256=stream_sha256(record.ticks[:num_ticks]))
    cut = replace(record, actions=[each for each in record.actions if each.tick != last], result=result)
    assert [(e.message, e.index) for e in disagreements(cut)] == ([] if has_left else [("Action", last)])
    found = [(each.message, each.index) for each in disagreements(without(cut, "actions", 20))]
    assert ("Action", cut.actions[20].tick) in found


def changed(record: EpisodeRecord, name: str, index: int, **fields: Any) -> EpisodeRecord:
    """The record with some fields of one message replaced."""
    messages = list(getattr(record, name))
    messages[index] = replace(messages[index], **fields)
    return replace(record, **{name: messages})


def without(record: EpisodeRecord, name: str, index: int) -> EpisodeRecord:
    messages = list(getattr(record, name))
    del messages[index]
    return replace(record, **{name: messages})


def bit_flipped(array: m.Floats, at: int = 0) -> m.Floats:
    copy = array.copy()
    copy.view(np.uint32).flat[at] ^= 1
    return copy


def rows_swapped(record: EpisodeRecord) -> EpisodeRecord:
    a, b = record.ticks[20], record.ticks[21]
    swapped = changed(record, "ticks", 20, raw_row=b.raw_row, action=b.action)
    return changed(swapped, "ticks", 21, raw_row=a.raw_row, action=a.action)


def shifted(record: EpisodeRecord, index: int) -> EpisodeRecord:
    tick = record.ticks[index]
    return changed(record, "ticks", index, deadline_ns=tick.deadline_ns + 1, decided_ns=tick.decided_ns + 1)


def clamped_wider(record: EpisodeRecord) -> EpisodeRecord:
    index = next(i for i, t in enumerate(record.ticks) if t.limits_hit)
    return changed(record, "ticks", index, action=record.ticks[index].raw_row)


def newer_reference(record: EpisodeRecord) -> EpisodeRecord:
    """Invocation 4 given the next query's cognition, consistently: vector, age, and every copy of them."""
    old = record.invocations[4]
    newer = record.cognitions[old.ref_query + 1]
    age_ns = old.now_ns - newer.source_ns
    record = changed(record, "invocations", 4, ref_query=newer.query, age_ns=age_ns, cognition=newer.vector)
    return changed(record, "chunks", 4, ref_query=newer.query, age_ns=age_ns)


MUTATIONS: dict[str, tuple[Callable[[EpisodeRecord], EpisodeRecord], str, str]] = {
    "an age off by a nanosecond": (
        lambda r: changed(r, "invocations", 3, age_ns=r.invocations[3].age_ns + 1),
        "Invocation 3",
        "age_ns",
    ),
    "a chunk that reports another age": (
        lambda r: changed(r, "chunks", 3, age_ns=r.chunks[3].age_ns + 1),
        "ActionChunk 3",
        "age_ns",
    ),
    "a reference one query too new": (newer_reference, "Invocation 4", "ref_query"),
    "two rows swapped": (rows_swapped, "Tick 20", "raw_row[0]"),
    "a dropped tick": (lambda r: without(r, "ticks", 17), "Tick 17", "tick"),
    "a dropped query": (lambda r: without(r, "queries", 2), "Query 2", "query"),
    "a dropped invocation": (lambda r: without(r, "invocations", 2), "Stamp of chunk 2", "answer"),
    "a dropped action": (lambda r: without(r, "actions", 9), "Action 9", "sent"),
    "a dropped cognition": (lambda r: without(r, "cognitions", 1), "Stamp of cognition 1", "answer"),
    "a cognition with one bit flipped": (
        lambda r: changed(r, "cognitions", 1, vector=bit_flipped(r.cognitions[1].vector, 5)),
        "Invocation",
        "cognition[5]",
    ),
    "an invocation with one bit flipped": (
        lambda r: changed(r, "invocations", 2, cognition=bit_flipped(r.invocations[2].cognition)),
        "Invocation 2",
        "cognition[0]",
    ),
    "another flow noise": (
        lambda r: changed(r, "invocations", 2, seed=r.invocations[2].seed + 1),
        "Invocation 2",
        "seed",
    ),
    "a tail with one bit flipped": (
        lambda r: changed(r, "invocations", 3, previous_rows=bit_flipped(r.invocations[3].previous_rows)),
        "Invocation 3",
        "previous_rows[0]",
    ),
    "a shifted deadline": (lambda r: shifted(r, 12), "Tick 12", "deadline_ns"),
    "a late tick in lockstep": (
        lambda r: changed(r, "ticks", 7, decided_ns=r.ticks[7].decided_ns + 1, late_ns=1, late_ms=1e-6),
        "Tick 7",
        "late_ns",
    ),
    "an action clamped otherwise": (clamped_wider, "Tick", "action["),
    "a command that is not what was sent": (
        lambda r: changed(r, "actions", 8, values=bit_flipped(r.actions[8].values)),
        "Action 8",
        "values[0]",
    ),
    "a level that hides staleness": (
        lambda r: changed(r, "ticks", 30, level=m.Level.STALE),
        "Tick 30",
        "level",
    ),
    "a stamp a nanosecond early": (
        lambda r: changed(r, "stamps", 0, ready_ns=r.stamps[0].ready_ns - 1),
        "Stamp of cognition 0",
        "ready_ns",
    ),
    "a doubled stamp": (
        lambda r: replace(r, stamps=[r.stamps[0], *r.stamps]),
        "Stamp of cognition 0",
        "times",
    ),
    "a query about another instant": (
        lambda r: changed(r, "observations", r.queries[1].tick, source_ns=r.queries[1].source_ns + 1),
        "Query 1",
        "source_ns",
    ),
    "a robot that was elsewhere": (
        lambda r: changed(r, "observations", 6, proprio=bit_flipped(r.observations[6].proprio)),
        "Tick 6",
        "state[0]",
    ),
    "a chunk for another tick": (
        lambda r: changed(r, "chunks", 2, t_row0=r.chunks[2].t_row0 + 1),
        "ActionChunk 2",
        "t_row0",
    ),
    "a result that counts otherwise": (
        lambda r: replace(r, result=replace(r.result, num_ticks=61)),
        "EpisodeResult 0",
        "num_ticks",
    ),
    "another stream": (
        lambda r: replace(r, result=replace(r.result, stream_sha256="0" * 64)),
        "EpisodeResult 0",
        "stream_sha256",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_the_first_wrong_number_is_named(name: str, good: EpisodeRecord) -> None:
    mutate, message, field = MUTATIONS[name]
    found = next(disagreements(mutate(good)))
    assert f"{found.message} {found.index}".startswith(message)
    assert found.field.startswith(field)
    assert found.expected != found.found


def test_queries_keep_their_period(good: EpisodeRecord) -> None:
    hasty = replace(good.info, schedule=replace(good.info.schedule, query_period_ns=1_000 * MS))
    found = next(disagreements(replace(good, info=hasty)))
    assert (found.message, found.index, found.field) == ("Query", 1, "period")


def test_invocations_keep_their_period(good: EpisodeRecord) -> None:
    hasty = replace(good.info, schedule=replace(good.info.schedule, invoke_period_ticks=10))
    found = next(disagreements(replace(good, info=hasty)))
    assert (found.message, found.field) == ("Invocation", "period")


def test_an_oracle_has_no_servers_to_check(good: EpisodeRecord) -> None:
    oracle = replace(
        good, info=replace(good.info, policy="oracle"), queries=[], cognitions=[], stamps=[], invocations=[], chunks=[]
    )
    assert list(disagreements(oracle)) == []
    assert next(disagreements(without(oracle, "ticks", 5))).index == 5


class TestCommandLine:
    @pytest.fixture
    def path(self, timing: Any, lockstep: Any, tmp_path: Path) -> Path:
        return lockstep(timing(), 40, seed=3).save(tmp_path / "episode.mcap")

    def test_agreement_is_exit_0(self, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main([str(path)]) == 0
        assert "agrees (40 ticks" in capsys.readouterr().out

    def test_disagreement_is_exit_1_and_is_named(
        self, timing: Any, lockstep: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        episode = lockstep(timing(), 40, seed=3)
        position = next(i for i, (x, _) in enumerate(episode.said) if isinstance(x, m.Invocation) and x.invocation == 2)
        invocation, wall_ns = episode.said[position]
        episode.said[position] = (replace(invocation, age_ns=invocation.age_ns + 1), wall_ns)
        assert main([str(episode.save(tmp_path / "wrong.mcap")), "--json"]) == 1
        told = json.loads(capsys.readouterr().out)
        assert told["agrees"] is False
        expected = {"message": "Invocation", "index": 2, "field": "age_ns"}
        assert expected.items() <= told["disagreement"].items()
        assert int(told["disagreement"]["found"]) - int(told["disagreement"]["expected"]) == 1

    @pytest.mark.parametrize("content", [b"", b"not a log", b"\x89MCAP0\r\n"])
    def test_what_cannot_be_read_is_exit_2(self, content: bytes, tmp_path: Path) -> None:
        (tmp_path / "broken.mcap").write_bytes(content)
        assert main([str(tmp_path / "broken.mcap")]) == 2
        assert main([str(tmp_path / "absent.mcap")]) == 2

    def test_recover_finishes_a_cut_log_and_checks_it(
        self, path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        cut = tmp_path / "cut.mcap.partial"
        cut.write_bytes(path.read_bytes()[: path.stat().st_size // 8])
        whole = tmp_path / "whole.mcap"
        assert main([str(cut), "--recover", str(whole)]) == 0
        assert "unfinished or damaged" in capsys.readouterr().out
        assert 0 < len(read_log(whole).ticks) < 40


def test_a_request_that_was_due_and_left_out_is_noticed(timing: Any, lockstep: Any, record_of: Any) -> None:
    long = record_of(lockstep(timing(), 120, seed=3))
    fewer = replace(long, queries=[query for query in long.queries if query.tick < 80])
    (found,) = [each for each in check_queries(fewer) if each.field == "sent"]
    assert (found.message, found.index, found.found) == ("Query", len(fewer.queries), "never")
    fewer = replace(long, invocations=[each for each in long.invocations if each.tick < 80])
    (found,) = [each for each in check_invocations(fewer, answers_of(fewer)) if each.field == "sent"]
    assert (found.message, found.index, found.found) == ("Invocation", len(fewer.invocations), "never")
    last_second = replace(long, queries=long.queries[:-1])  # it may have been on its way
    assert not [each for each in check_queries(last_second) if each.field == "sent"]
    away = m.Event(severity=m.Severity.WARNING, name="query_skipped", text="PONDER is away")
    assert not [each for each in check_queries(replace(long, queries=[], events=[away])) if each.field == "sent"]


def test_committed_rows_are_those_that_were_left(good: EpisodeRecord) -> None:
    last = good.invocations[-1]
    changed = [*good.invocations[:-1], replace(last, committed_rows=last.committed_rows + 1000)]
    found = list(check_invocations(replace(good, invocations=changed), answers_of(good)))
    assert "committed_rows" in {each.field for each in found}
