"""A POUNCE that reads no pictures: it takes any robot's cameras, and what they show changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.tasks import panda
from pounce_server.contract import Request, check_robot
from pounce_server.engine import EagerEngine
from sim_client.panda_robot import simulated_robot

PANDA = simulated_robot(panda.PANDA_WRISTCAM, np.append(panda.HOME_QPOS, 0.04))
CONFIG = replace(tiny_cpu(cognition_size=64), num_cameras=0)


@pytest.fixture(scope="module")
def engine() -> EagerEngine:
    return EagerEngine(random_bundle(CONFIG, seed=0))


def request(**changes: object) -> Request:
    asked = Request(
        frames=(),
        proprio=np.zeros(8, np.float32),
        instruction="press the button",
        cognition=np.zeros((1, 64), np.float32),
        age_ns=300_000_000,
        seed=1,
    )
    return replace(asked, **changes)  # type: ignore[arg-type]


def test_it_acts_on_state_and_cognition(engine: EagerEngine) -> None:
    rows = engine.invoke(request())
    assert rows.shape == (engine.spec.horizon, 8)
    assert not np.array_equal(rows, engine.invoke(request(cognition=np.ones((1, 64), np.float32))))
    assert not np.array_equal(rows, engine.invoke(request(proprio=np.full(8, 0.1, np.float32))))
    assert len(engine.warm_up()) >= 20


def test_any_robots_cameras_will_do_and_pictures_are_not_taken(engine: EagerEngine) -> None:
    for cameras in ((), ("front",), ("front", "wrist", "side")):
        check_robot(replace(PANDA, cameras=cameras), engine.spec)
    with pytest.raises(ValueError, match="expected 0 frames"):
        engine.invoke(request(frames=(np.zeros((8, 8, 3), np.uint8),)))


def test_several_robots_at_once_get_what_each_gets_alone(engine: EagerEngine) -> None:
    asked = [request(seed=seed) for seed in (1, 2)]
    for together, alone in zip(engine.invoke_many(asked), [engine.invoke(one) for one in asked], strict=True):
        np.testing.assert_allclose(together, alone, atol=1e-5)
