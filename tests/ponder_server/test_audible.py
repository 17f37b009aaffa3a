"""A forward is heard layer by layer, leaves nothing behind, and may be ended from there."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

CONFIG = replace(tiny_cpu(), num_layers=8, vision_depth=2, image_px=(64, 64))
NUM_PARTS = CONFIG.num_layers + CONFIG.vision_depth
FRAMES = tuple(np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8))
OPENING = Opening(instruction="press the button", demo_frames=((FRAMES[0],), (FRAMES[1],)))


@pytest.fixture
def engine() -> QwenEngine:
    return QwenEngine(Ponder.random(CONFIG, seed=3), EngineConfig(max_context_tokens=400, max_sessions=1))


class Ear:
    """Counts, and at the given count says that it is enough."""

    def __init__(self, enough: int = -1) -> None:
        self.count = 0
        self._enough = enough

    def __call__(self) -> None:
        self.count += 1
        if self.count == self._enough:
            raise InterruptedError("enough")


def test_every_layer_is_heard(engine: QwenEngine) -> None:
    opened, fired = Ear(), Ear()
    engine.open("a", OPENING, opened)
    engine.fire("a", FRAMES, fired)
    assert opened.count > NUM_PARTS
    assert fired.count > NUM_PARTS


def test_afterwards_nobody_listens(engine: QwenEngine) -> None:
    engine.open("a", OPENING)
    ear = Ear()
    engine.fire("a", FRAMES, ear)
    heard = ear.count
    engine.fire("a", FRAMES)
    assert ear.count == heard


@pytest.mark.parametrize("enough", [3, NUM_PARTS - 1])
def test_a_forward_that_is_ended_in_a_layer_never_happened(engine: QwenEngine, enough: int) -> None:
    engine.open("a", OPENING)
    with pytest.raises(InterruptedError):
        engine.fire("a", FRAMES, Ear(enough))
    answer = engine.fire("a", FRAMES)
    fresh = QwenEngine(Ponder.random(CONFIG, seed=3), EngineConfig(max_context_tokens=400, max_sessions=1))
    fresh.open("a", OPENING)
    assert torch.equal(torch.from_numpy(answer.cognition), torch.from_numpy(fresh.fire("a", FRAMES).cognition))


def test_an_opening_that_is_ended_in_a_layer_leaves_the_session_free(engine: QwenEngine) -> None:
    with pytest.raises(InterruptedError):
        engine.open("a", OPENING, Ear(enough=NUM_PARTS - 1))
    engine.open("a", OPENING)
    assert np.isfinite(engine.fire("a", FRAMES).cognition).all()
