"""A short episode in real time: nobody waits, and everything is accounted for."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from clock.check import disagreements
from protocol import messages as m

pytestmark = [pytest.mark.e2e, pytest.mark.realtime, pytest.mark.sim, pytest.mark.slow]

NUM_TICKS = 60


@pytest.fixture(scope="module")
def episode(machine: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    player = machine.play(Path(tmp_path_factory.mktemp("realtime")), "--max-steps", str(NUM_TICKS))
    return player.wait_for_end()


def test_every_tick_is_logged_once_and_in_order(episode: Any) -> None:
    assert [t.tick for t in episode.record.ticks] == list(range(NUM_TICKS))


def test_a_played_tick_says_which_row_of_which_chunk_and_how_old_its_cognition_was(episode: Any) -> None:
    chunks = {c.invocation: c for c in episode.record.chunks}
    played = [t for t in episode.record.ticks if t.level in (m.Level.PLAY, m.Level.STALE)]
    assert played
    for tick in played:
        chunk = chunks[tick.invocation]
        assert (tick.t_row0 + tick.row, tick.ref_query, tick.age_ns) == (tick.tick, chunk.ref_query, chunk.age_ns)
        assert tick.age_ns > 0
        assert tick.raw_row.tobytes() == chunk.rows_NA[tick.row].tobytes()


def test_deadlines_are_50_ms_apart_and_no_decision_comes_before_its_deadline(episode: Any) -> None:
    ticks = episode.record.ticks
    assert {b.deadline_ns - a.deadline_ns for a, b in pairwise(ticks)} == {50_000_000}
    assert min(t.late_ns for t in ticks) >= 0


def test_the_log_follows_from_itself(episode: Any) -> None:
    assert not episode.record.recovered
    assert next(disagreements(episode.record), None) is None


def test_results_tell_what_ran_and_how_it_went(episode: Any) -> None:
    assert set(episode.results) >= {"config", "versions", "episodes"}
    assert {"ponderpounce-server", "python", "mujoco", "eclipse-zenoh"} <= set(episode.results["versions"])
    assert episode.results["config"]["mode"] == "realtime"
    result = episode.result
    assert (result["status"], result["steps"], result["success"]) == ("TIMEOUT", NUM_TICKS, False)
    assert (result["task"], result["seed"]) == ("PickHighlight", 0)
    assert len(result["stream_sha256"]) == 64
    assert {"late_ms_p99", "age_ms_p50", "query_delay_ms_p50", "invoke_delay_ms_p50"} <= set(result["schedule"])
    assert any("untrained" in warning for warning in result["warnings"])
