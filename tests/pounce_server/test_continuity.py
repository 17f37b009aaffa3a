"""An engine that continues the rows being played, from the fields that an invocation brings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from pounce_server.contract import Continuity, Request, example_request
from pounce_server.engine import EagerEngine
from protocol import messages as m

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


@pytest.mark.parametrize("continuity", ["rtc", "trained"])
def test_groot_has_no_such_mode(continuity: Continuity) -> None:
    with pytest.raises(ValueError, match=r"is pi0\.5's only"):
        EagerEngine(random_bundle(tiny_groot(), seed=0), continuity=continuity)


# -- trained to continue: rows are given


@pytest.fixture(scope="module")
def trained() -> EagerEngine:
    config = replace(tiny_cpu(), max_committed_rows=4)
    return EagerEngine(random_bundle(config, seed=0), continuity="trained")


def test_a_checkpoint_that_never_learned_to_is_refused() -> None:
    with pytest.raises(ValueError, match="never trained to continue rows"):
        EagerEngine(random_bundle(tiny_cpu(), seed=0), continuity="trained")


def test_without_committed_rows_a_trained_engine_is_the_plain_one_bit_for_bit(
    trained: EagerEngine, plain: EagerEngine, request_: Request
) -> None:
    given = replace(request_, previous_rows=np.ones((20, 8), np.float32))
    np.testing.assert_array_equal(trained.invoke(given), plain.invoke(request_))


@given(
    num_previous=st.integers(0, 20),
    committed=st.integers(0, 20),
    row0=st.integers(0, 3),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=25, deadline=None)
def test_committed_rows_come_out_as_they_came(
    trained: EagerEngine, num_previous: int, committed: int, row0: int, seed: int
) -> None:
    committed = min(committed, num_previous)
    previous = np.random.default_rng(seed).uniform(-1, 1, (num_previous, 8)).astype(np.float32)
    request = replace(example_request(trained.spec), **NONE)
    asked = replace(request, previous_rows=previous, previous_row0=row0, committed_rows=committed)
    rows = trained.invoke(asked)
    kept = max(0, min(row0 + committed, 4) - row0) if committed else 0
    assert rows.shape == (20, 8)
    np.testing.assert_array_equal(rows[row0 : row0 + kept], previous[:kept])


def test_what_is_given_decides_the_rest(trained: EagerEngine, request_: Request) -> None:
    near, far = (np.full((4, 8), value, np.float32) for value in (0.0, 0.2))
    first, second = (
        trained.invoke(replace(request_, previous_rows=rows, committed_rows=4))[4:] for rows in (near, far)
    )
    assert np.abs(first - second).mean() > 1e-3


def test_robots_of_one_batch_are_given_their_own_rows(trained: EagerEngine, request_: Request) -> None:
    rows = trained.invoke(request_)
    robots = [replace(request_, seed=1), replace(request_, seed=2, previous_rows=rows, committed_rows=3)]
    for together, robot in zip(trained.invoke_many(robots), robots, strict=True):
        np.testing.assert_allclose(together, trained.invoke(robot), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("delay_ms", "is_refused"), [(200, False), (201, True)])
def test_a_schedule_that_commits_more_rows_than_were_learned_is_refused(
    new_rig: Callable[..., Any],
    episode_info: Callable[..., m.EpisodeInfo],
    robot_with: Callable[..., m.Robot],
    paper: m.Schedule,
    delay_ms: int,
    is_refused: bool,
) -> None:
    config = replace(tiny_cpu(num_carriers=2, cognition_size=8), max_committed_rows=4)
    rig = new_rig(pounce_engine=EagerEngine(random_bundle(config, seed=0), continuity="trained"))
    low, high, step = (np.full(8, value, np.float32) for value in (-3, 3, 0.2))
    robot = robot_with(command_low=low, command_high=high, max_step=step, initial_command=0 * low, num_proprio=8)
    delay = m.Delay(kind=m.DelayKind.FIXED, mean_ns=delay_ms * 1_000_000)
    reply = rig.open(episode_info(replace(paper, invoke_delay=delay, invoke_period_ticks=10), robot=robot))
    assert ("takes 5 ticks here, and this checkpoint learned to continue at most 4 rows" in reply.error) is is_refused
    assert bool(reply.error) is is_refused
