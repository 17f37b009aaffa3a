"""The judge of the fault benchmark, which knows none of the clock's rules, finds commands that come from nowhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fault_judge import unbidden, verdict
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log

MEASURED = m.Delay(kind=m.DelayKind.MEASURED)
NUM_TICKS = 120


@pytest.fixture(scope="module")
def path(timing: Any, realtime: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode that plays, holds, slows down, stops and plays again."""
    timed = timing(query_delay=MEASURED, invoke_delay=MEASURED)
    episode = realtime(timed, NUM_TICKS, seed=5, stalls=0.0, silence=range(6, 10))
    return Path(episode.save(tmp_path_factory.mktemp("log") / "episode.mcap"))


@pytest.fixture(scope="module")
def record(path: Path) -> EpisodeRecord:
    record = read_log(path)
    assert {m.Level.PLAY, m.Level.HOLD, m.Level.DECELERATE, m.Level.STOPPED} <= {t.level for t in record.ticks}
    return record


def test_a_good_episode_has_none(record: EpisodeRecord, path: Path) -> None:
    assert list(unbidden(record)) == []
    assert verdict(path) == ("whole", "")


@pytest.mark.parametrize("by", [-0.3, 0.3])
def test_any_other_command_is_found(by: float, record: EpisodeRecord) -> None:
    for index, tick in enumerate(record.ticks):
        if not len(tick.action):
            continue
        action = tick.action.copy()
        is_stopping = tick.level in (m.Level.DECELERATE, m.Level.STOPPED)  # where any way to the joints would do
        action[0] += np.float32(by if is_stopping else by / 300)
        ticks = [*record.ticks[:index], replace(tick, action=action, limits_hit=0), *record.ticks[index + 1 :]]
        sent = [replace(a, values=action) if a.tick == tick.tick else a for a in record.actions]
        assert list(unbidden(replace(record, ticks=ticks, actions=sent))), f"tick {tick.tick} {tick.level.name}"


def test_a_row_without_its_chunk_and_a_command_that_is_not_accounted_for_are_found(record: EpisodeRecord) -> None:
    assert any("is not in the log" in sentence for sentence in unbidden(replace(record, chunks=[])))
    first, *others = record.actions
    changed = replace(first, values=first.values + np.float32(0.001))
    assert any("not the one in its account" in s for s in unbidden(replace(record, actions=[changed, *others])))


def test_a_log_that_ends_early_is_cut_and_one_that_was_changed_is_wrong(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap.partial"
    cut.write_bytes(path.read_bytes()[:-2000])
    state, why = verdict(cut)
    assert (state, bool(why)) == ("cut", True)
    garbage = tmp_path / "garbage.mcap"
    garbage.write_bytes(b"garbage")
    assert verdict(garbage)[0] == "wrong"
