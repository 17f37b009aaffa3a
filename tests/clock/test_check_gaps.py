"""A log that lacks messages in the middle is checked up to there, and what it lacks is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.check import disagreements
from clock.check_gaps import before_gaps
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log

OF_CLOCK = ("queries", "stamps", "invocations", "actions", "ticks", "events")


@pytest.fixture(scope="module")
def path(timing: Any, lockstep: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of an episode of 60 ticks."""
    saved: Path = lockstep(timing(), 60, seed=3).save(tmp_path_factory.mktemp("log") / "episode.mcap")
    return saved


@pytest.fixture
def whole(path: Path) -> EpisodeRecord:
    return read_log(path)


def without(record: EpisodeRecord, start_ns: int, end_ns: int, kinds: set[str]) -> EpisodeRecord:
    """``record`` without what the clock service sent in this time."""
    kept = {k: [each for each in getattr(record, k) if not start_ns <= each.header.at_ns < end_ns] for k in kinds}
    return replace(record, **kept)


def test_a_whole_log_is_left_as_it_is(whole: EpisodeRecord) -> None:
    assert before_gaps(whole) == (whole, "")


@settings(max_examples=40, deadline=None)
@given(
    start_tick=st.integers(1, 55),
    num_ticks=st.integers(1, 20),
    kinds=st.sets(st.sampled_from(OF_CLOCK), min_size=1),
)
def test_what_is_before_a_gap_agrees(start_tick: int, num_ticks: int, kinds: set[str], path: Path) -> None:
    whole = read_log(path)

    def at_ns(tick: int) -> int:
        return whole.ticks[tick].header.at_ns

    cut = without(whole, at_ns(start_tick), at_ns(min(start_tick + num_ticks, 59)), kinds)
    part, why = before_gaps(cut)
    assert not why or next(disagreements(part), None) is None  # what ends a kind leaves no gap: nobody can know
    for kind in OF_CLOCK:
        assert getattr(part, kind) == getattr(whole, kind)[: len(getattr(part, kind))]
    if "ticks" in kinds and start_tick + num_ticks < 59:
        assert f"{num_ticks} of the ticks of clock" in why
        assert (part.recovered, part.result) == (True, None)
        assert len(part.ticks) < start_tick + 1


@pytest.mark.parametrize("position", [1, -1])
def test_a_lost_answer_ends_it_where_it_was_first_used(position: int, whole: EpisodeRecord) -> None:
    """The last one has no later number beside it."""
    cut = replace(whole, chunks=[each for each in whole.chunks if each is not whole.chunks[position]])
    assert next(disagreements(cut), None) is not None
    part, why = before_gaps(cut)
    assert next(disagreements(part), None) is None
    assert "1 of the chunks of pounce" in why


@pytest.mark.parametrize("kind", [m.StampKind.COGNITION, m.StampKind.CHUNK])
def test_a_lost_last_stamp_is_known_by_what_it_admitted(kind: m.StampKind, whole: EpisodeRecord) -> None:
    is_chunk = kind == m.StampKind.CHUNK
    used = [tick.invocation for tick in whole.ticks] if is_chunk else [each.ref_query for each in whole.invocations]
    last = max(index for index in used if index is not None)
    at = next(n for n, stamp in enumerate(whole.stamps) if (stamp.kind, stamp.index) == (kind, last))
    cut = replace(whole, stamps=whole.stamps[:at])
    assert next(disagreements(cut), None) is not None
    part, why = before_gaps(cut)
    assert next(disagreements(part), None) is None
    assert part.ticks
    assert "of the stamps of clock never reached the recorder" in why


def test_the_command_names_it(
    whole: EpisodeRecord, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from clock import check

    cut = without(whole, whole.ticks[20].header.at_ns, whole.ticks[26].header.at_ns, {"ticks"})
    monkeypatch.setattr(check, "read_log", lambda path: cut)
    assert check.main([str(tmp_path / "cut.mcap")]) == 0
    said = capsys.readouterr().out
    assert "6 of the ticks of clock never reached the recorder" in said
    assert "agrees (19 ticks" in said


def test_a_log_of_which_nothing_can_be_checked_does_not_pass(
    whole: EpisodeRecord, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from clock import check

    monkeypatch.setattr(check, "read_log", lambda path: replace(whole, chunks=[], cognitions=[]))
    assert check.main([str(tmp_path / "cut.mcap")]) == 2
    assert "nothing of it can be checked: checked up to " in capsys.readouterr().out
