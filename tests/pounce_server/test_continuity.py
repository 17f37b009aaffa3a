"""An engine that continues the rows being played, from the fields that an invocation brings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ponderpounce.models.pounce_checkpoint import random_bundle
from ponderpounce.models.pounce_configs import tiny_cpu, tiny_groot
from pounce_server.contract import Request, example_request
from pounce_server.engine import EagerEngine

NONE: dict[str, Any] = {"previous_rows": None, "committed_rows": 0}


@pytest.fixture(scope="module")
def plain() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_cpu(), seed=0))


@pytest.fixture(scope="module")
def engine() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_cpu(), seed=0), continuity="rtc")


@pytest.fixture
def request_(engine: EagerEngine) -> Request:
    return replace(example_request(engine.spec), **NONE)


def miss(rows: Any, previous: Any) -> Any:
    """Mean distance per row of the arm's joints (rad)."""
    return np.abs(rows[: len(previous), :7] - previous[:, :7]).mean(axis=1)


def test_without_previous_rows_it_is_the_plain_engine_bit_for_bit(
    engine: EagerEngine, plain: EagerEngine, request_: Request
) -> None:
    np.testing.assert_array_equal(engine.invoke(request_), plain.invoke(request_))


def test_a_plain_engine_does_not_look_at_previous_rows(plain: EagerEngine, request_: Request) -> None:
    given = replace(request_, previous_rows=np.ones((20, 8), np.float32), committed_rows=20)
    np.testing.assert_array_equal(plain.invoke(given), plain.invoke(request_))


def test_committed_rows_are_continued(engine: EagerEngine, request_: Request) -> None:
    previous = engine.invoke(request_)
    again = replace(request_, seed=1)
    continued = engine.invoke(replace(again, previous_rows=previous, committed_rows=20))
    assert miss(continued, previous).mean() < 0.1 * miss(engine.invoke(again), previous).mean()


def test_the_tail_of_a_chunk_is_met_where_it_belongs(engine: EagerEngine, request_: Request) -> None:
    """Two ticks passed between the observation and the invocation: the first row left is the new chunk's third."""
    previous = engine.invoke(request_)
    given = replace(request_, seed=1, previous_rows=previous[2:12], previous_row0=2, committed_rows=10)
    continued, free = engine.invoke(given), engine.invoke(replace(request_, seed=1))
    assert miss(continued[2:], previous[2:12]).mean() < 0.1 * miss(free[2:], previous[2:12]).mean()


def test_robots_of_one_batch_continue_their_own_rows(engine: EagerEngine, request_: Request) -> None:
    rows = engine.invoke(request_)
    robots = [replace(request_, seed=1), replace(request_, seed=2, previous_rows=rows, committed_rows=5)]
    for together, robot in zip(engine.invoke_many(robots), robots, strict=True):
        np.testing.assert_allclose(together, engine.invoke(robot), rtol=0, atol=1e-4)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "more than there are": ({"previous_rows": np.zeros((3, 8), np.float32), "committed_rows": 4}, "expected 0..3"),
    "none but committed": ({"committed_rows": 1}, "committed_rows: expected 0..0"),
    "other dims": ({"previous_rows": np.zeros((3, 7), np.float32)}, r"previous_rows: expected \(3, 8\)"),
    "future": ({"previous_row0": -1}, "previous_row0 must not be negative"),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_misfits_are_refused_by_name(
    engine: EagerEngine, request_: Request, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        engine.invoke(replace(request_, **changes))


def test_groot_has_no_such_mode() -> None:
    with pytest.raises(ValueError, match=r"is pi0\.5's only"):
        EagerEngine(random_bundle(tiny_groot(), seed=0), continuity="rtc")
