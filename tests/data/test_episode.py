"""An episode on disk: what is written is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from dual_system.data.episode import EXECUTED, Package, Rejection, Rows, from_table, to_table, unpack


def test_what_is_packed_is_unpacked(package: Callable[..., Package]) -> None:
    rejected = (Rejection(seed=7, reason="fail after 3 steps: the cube fell"),)
    episode = unpack(package(4, num_rows=6, rejected=rejected, recovery="xy"))
    assert episode.about.rejected == rejected
    assert episode.about.recovery == "xy"
    assert episode.rows.is_demonstration.tolist() == [True, True, False, False, False, False]
    assert episode.rows.is_rendered.tolist() == [True, False] * 3
    assert episode.rows.demonstration_reasoning[2] == "it was the second one"
    rng = np.random.default_rng(4)
    rng.integers(0, 256, (16, 16, 3), np.uint8), rng.integers(0, 256, (16, 16, 3), np.uint8)
    np.testing.assert_array_equal(episode.rows.state[0], rng.normal(size=8).astype(np.float32))
    assert episode.pixels["front"].num_frames == 1  # one a second


def test_equal_episodes_are_equal_bytes(package: Callable[..., Package]) -> None:
    assert package(5) == package(5)
    assert package(5) != package(6)


def test_every_column_has_a_value_for_every_row(package: Callable[..., Package]) -> None:
    rows = unpack(package(4, num_rows=6, nudge_rad=0.1)).rows
    assert {len(getattr(rows, each.name)) for each in fields(Rows)} == {6}
    read = from_table(to_table(rows))
    np.testing.assert_array_equal(read.executed_action, rows.executed_action)
    missing = {each.name for each in fields(Rows) if getattr(unpack(package(4)).rows, each.name) is None}
    assert missing == {EXECUTED}
