"""Several robots at once: each gets the rows that it would get alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from torch.utils._python_dispatch import TorchDispatchMode

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from pounce_server.contract import Request, example_request
from pounce_server.engine import EagerEngine

CONFIGS = {"pi05": tiny_cpu, "groot": tiny_groot}
TOLERANCE_RAD = 1e-5
"""Of rows, in robot units: products of another size round otherwise."""


@pytest.fixture(scope="module", params=CONFIGS)
def engine(request: pytest.FixtureRequest) -> EagerEngine:
    return EagerEngine(random_bundle(CONFIGS[request.param](num_carriers=2, cognition_size=24), seed=0))


@pytest.fixture
def robots(engine: EagerEngine) -> list[Request]:
    """Nothing in common: prompts of three lengths, either camera missing, cognition null and old."""
    one, two, three, four = (example_request(engine.spec, seed=seed) for seed in range(4))
    return [
        one,
        replace(two, instruction="pick", frames=(two.frames[0], None), cognition=None, age_ns=0),
        replace(three, instruction="put the peg into the box", frames=(None, three.frames[1]), age_ns=2_000_000_000),
        replace(four, proprio=np.full(8, 0.3, np.float32)),
    ]


def test_together_as_alone(engine: EagerEngine, robots: list[Request]) -> None:
    for together, request in zip(engine.invoke_many(robots), robots, strict=True):
        np.testing.assert_allclose(together, engine.invoke(request), rtol=0, atol=TOLERANCE_RAD)


def test_no_robot_moves_for_what_another_is_told(engine: EagerEngine, robots: list[Request]) -> None:
    before = engine.invoke_many(robots)
    robots[3] = replace(robots[3], instruction="stack the cubes on the plate " * 2, seed=99)
    after = engine.invoke_many(robots)
    for index in range(3):
        np.testing.assert_allclose(after[index], before[index], rtol=0, atol=TOLERANCE_RAD)
    assert np.abs(after[3] - before[3]).max() > 100 * TOLERANCE_RAD


def test_the_order_of_robots_is_the_order_of_rows(engine: EagerEngine, robots: list[Request]) -> None:
    forwards, backwards = engine.invoke_many(robots), engine.invoke_many(robots[::-1])
    for one, other in zip(forwards, backwards[::-1], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=TOLERANCE_RAD)


def test_a_batch_of_one_is_an_invocation_bit_for_bit(engine: EagerEngine, robots: list[Request]) -> None:
    for request in robots:
        (rows,) = engine.invoke_many([request])
        np.testing.assert_array_equal(rows, engine.invoke(request))


def test_nobody_at_all_may_have_a_cognition(engine: EagerEngine, robots: list[Request]) -> None:
    without = [replace(request, cognition=None, age_ns=0) for request in robots]
    for together, request in zip(engine.invoke_many(without), without, strict=True):
        np.testing.assert_allclose(together, engine.invoke(request), rtol=0, atol=TOLERANCE_RAD)


def test_one_misfit_is_named_and_stops_the_batch(engine: EagerEngine, robots: list[Request]) -> None:
    robots[2] = replace(robots[2], frames=(None, None))
    beats: list[None] = []
    with pytest.raises(ValueError, match="request 2: all 2 cameras are missing"):
        engine.invoke_many(robots, lambda: beats.append(None))
    assert not beats


def test_an_empty_batch_is_refused(engine: EagerEngine) -> None:
    with pytest.raises(ValueError, match="at least one request"):
        engine.invoke_many([])


def test_no_flow_step_writes_rows_by_a_list_of_indices(engine: EagerEngine, robots: list[Request]) -> None:
    """On a GPU such a list is copied there, and the host waits, once a step."""
    seen: list[str] = []

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            seen.append(str(func))
            return func(*args, **(kwargs or {}))

    with Watch():
        engine.invoke_many(robots)
    assert seen
    assert not [name for name in seen if "index_put" in name]
