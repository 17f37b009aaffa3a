"""A PONDER with a reader of demonstrations is served as it was trained, by whoever's weights a token is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.int8 import Int8Linear
from dual_system.models.ponder.context import Transition
from dual_system.models.ponder.network import Ponder
from ponder_server.engine import QwenEngine
from tests.ponder_server.test_engine import (
    CONFIG,
    SUBGOAL,
    TOLERANCE,
    WITH_DEMO,
    WITHOUT_DEMO,
    Script,
    context_of,
    encode,
    observation,
    taught,
    training_row,
)
from tests.ponder_server.test_opening import NOTES

SCRIPT: Script = (Transition(subgoal=SUBGOAL), None, None)
NOT_FAR = 0.02


def reading() -> Ponder:
    """It says what it was taught, and its reader's weights are others."""
    ponder = taught(SCRIPT, notes=NOTES)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for weight in ponder.add_reader().parameters():
            weight.mul_(1 + NOT_FAR * torch.randn(weight.shape, generator=generator))
    return ponder


@pytest.mark.parametrize("buckets", [(1, 16, 160), (512,)])
def test_serving_regenerates_the_training_row(buckets: tuple[int, ...]) -> None:
    """Beside sessions without a demonstration, and from a demonstration that was shown before."""
    ponder = reading()
    row = training_row(ponder, SCRIPT, notes=NOTES)
    plain = training_row(ponder, (None, None, None), WITHOUT_DEMO)
    expected = encode(ponder, row)[torch.from_numpy(row.carrier_index)]
    expected_plain = encode(ponder, plain, WITHOUT_DEMO)[torch.from_numpy(plain.carrier_index)]
    engine = QwenEngine(ponder, replace(CONFIG, buckets=buckets))
    for session in ("a", "b"):
        engine.open(session, WITH_DEMO)
    engine.open("plain", WITHOUT_DEMO)
    for query in range(len(SCRIPT)):
        sessions = {"a": expected, "b": expected, "plain": expected_plain}
        for session in sessions:
            engine.begin(session, observation(query), saying=() if session == "plain" else None)
        while sessions:
            for outcome in engine.step():
                wanted = sessions.pop(outcome.session)[query].numpy()
                assert np.abs(outcome.unwrap().cognition - wanted).max() < TOLERANCE
    assert context_of(engine, "a").ids == context_of(engine, "b").ids == list(row.ids)
    by_one_alone = encode(taught(SCRIPT, notes=NOTES), row)[torch.from_numpy(row.carrier_index)]
    assert (by_one_alone - expected).abs().amax(dim=(1, 2)).min() > TOLERANCE, "it makes a difference at every query"


def test_a_first_answer_that_is_taken_back_is_the_readers_once_more() -> None:
    engine = QwenEngine(reading(), CONFIG)
    engine.open("a", WITH_DEMO)
    first = engine.fire("a", observation(0)).cognition
    second = engine.fire("a", observation(1)).cognition
    engine.close("a")
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    engine.undo("a")
    assert np.array_equal(engine.fire("a", observation(0)).cognition, first)
    engine.fire("a", observation(1))
    engine.undo("a")
    assert np.array_equal(engine.fire("a", observation(1)).cognition, second)


def test_a_first_query_that_fails_leaves_the_next_to_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = QwenEngine(reading(), CONFIG)
    engine.open("a", WITH_DEMO)
    expected = engine.fire("a", observation(0)).cognition
    engine.open("b", WITH_DEMO)
    with monkeypatch.context() as broken:
        broken.setattr(np, "isfinite", lambda values: np.zeros(values.shape, np.bool_))
        with pytest.raises(FloatingPointError):
            engine.fire("b", observation(0))
    assert np.array_equal(engine.fire("b", observation(0)).cognition, expected)


def test_narrow_weights_are_the_readers_too() -> None:
    ponder = reading()
    engine, exact = QwenEngine(ponder, replace(CONFIG, weights="int8")), QwenEngine(reading(), CONFIG)
    assert ponder.reader is not None
    layers = [module for layer in ponder.reader.layers for module in layer.modules()]
    exact_ones = [module for module in layers if type(module) is torch.nn.Linear]
    num_recurrent = sum(hasattr(layer, "linear_attn") for layer in ponder.reader.layers)
    assert len(exact_ones) == 2 * num_recurrent, "only what sets decay and writing strength stays as it is"
    assert any(isinstance(module, Int8Linear) for module in layers)
    for each in (engine, exact):
        each.open("a", WITH_DEMO)
    told, wanted = (each.fire("a", observation(0)).cognition for each in (engine, exact))
    assert 0 < np.abs(told - wanted).max() < 0.5 * np.abs(wanted).max()
