"""The statistics count what happened, and the hash moves with everything that was commanded and nothing else."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from clock.report import num_starved, statistics, stream_sha256
from protocol import messages as m

MS = 1_000_000


def tick(number: int, level: m.Level = m.Level.PLAY, **fields: Any) -> m.Tick:
    row = np.array([0.5, number], np.float32)
    values: dict[str, Any] = {
        "deadline_ns": 50 * MS * number,
        "decided_ns": 50 * MS * number + 2 * MS,
        "late_ns": 2 * MS,
        "invocation": 0,
        "ref_query": 0,
        "age_ns": 300 * MS,
        "action": row,
        "raw_row": row,
    }
    return m.Tick(tick=number, level=level, **(values | fields))


def held(number: int) -> m.Tick:
    nothing = np.zeros(0, np.float32)
    return tick(number, m.Level.HOLD, invocation=None, ref_query=None, age_ns=0, raw_row=nothing)


def test_the_hash_is_over_the_documented_bytes() -> None:
    ticks = [tick(0), held(1)]
    expected = struct.pack("<qI2fqq", 0, 2, 0.5, 0.0, 0, 300 * MS) + struct.pack("<qI2fqq", 1, 2, 0.5, 1.0, -1, 0)
    assert stream_sha256(ticks) == hashlib.sha256(expected).hexdigest()
    assert stream_sha256([]) == hashlib.sha256(b"").hexdigest()


@pytest.mark.parametrize(
    "change",
    [
        {"tick": 1},
        {"action": np.array([0.5, np.nextafter(np.float32(0), np.float32(1))], np.float32)},
        {"action": np.array([0.5], np.float32)},
        {"ref_query": None},
        {"ref_query": 1},
        {"age_ns": 300 * MS + 1},
    ],
)
def test_the_hash_moves_with_what_was_commanded(change: Any) -> None:
    assert stream_sha256([replace(tick(0), **change)]) != stream_sha256([tick(0)])


@pytest.mark.parametrize("change", [{"decided_ns": 7}, {"late_ns": 7}, {"late_ms": 7.0}, {"state": np.ones(2)}])
def test_the_hash_ignores_when_the_clock_came_to_it(change: Any) -> None:
    assert stream_sha256([replace(tick(0), **change)]) == stream_sha256([tick(0)])


def test_levels_and_starved_ticks_are_counted() -> None:
    ticks = [held(0), tick(1), held(2), held(3), tick(4, m.Level.STALE), tick(5, m.Level.SKIPPED)]
    found = statistics(ticks, [], [])
    assert (found["num_ticks"], found["play_ticks"], found["stale_ticks"]) == (6, 1, 1)
    assert (found["hold_ticks"], found["skipped_ticks"], found["stopped_ticks"]) == (3, 1, 0)
    assert found["starved_ticks"] == num_starved(ticks) == 2  # the one before the first row lost nothing


def test_a_row_that_may_not_be_played_is_not_starvation() -> None:
    ticks = [tick(0), tick(1, m.Level.HOLD, invocation=None, ref_query=None, limits_hit=4)]
    assert num_starved(ticks) == 0
    assert statistics(ticks, [], [])["non_finite_rows"] == 1


def test_percentiles_are_observed_values() -> None:
    ticks = [tick(k, late_ns=k * MS) for k in range(100)]
    found = statistics(ticks, [], [])
    assert [found[f"late_ms_{p}"] for p in ("p50", "p95", "p99", "max")] == [49.0, 94.0, 98.0, 99.0]


def test_ages_are_of_played_rows_with_a_cognition() -> None:
    ticks = [tick(0, ref_query=None, age_ns=0), tick(1), held(2)]
    assert statistics(ticks, [], [])["age_ms_p50"] == 300.0


def test_a_seam_is_between_two_chunks() -> None:
    ticks = [tick(0, seam_jump=9.0), tick(1), tick(2, invocation=1, seam_jump=0.25), tick(3, invocation=1)]
    found = statistics(ticks, [], [])
    assert (found["seam_jump_rad_p50"], found["seam_jump_rad_max"]) == (0.25, 0.25)


def test_delays_come_from_the_stamps() -> None:
    def stamp(kind: m.StampKind, delay_ms: int) -> m.Stamp:
        return m.Stamp(kind=kind, index=0, source_ns=5, ready_ns=5 + delay_ms * MS, arrived_ns=0)

    found = statistics([], [stamp(m.StampKind.COGNITION, 300), stamp(m.StampKind.CHUNK, 80)], [])
    assert (found["query_delay_ms_max"], found["invoke_delay_ms_max"]) == (300.0, 80.0)


def test_what_nobody_observed_is_absent() -> None:
    assert not any(name.startswith(("late_ms", "age_ms", "seam", "query_delay")) for name in statistics([], [], []))
