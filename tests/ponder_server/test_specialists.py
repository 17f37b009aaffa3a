"""An episode that a specialist is for is served as if there were nobody else's weights, beside others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models.int8 import Int8Linear
from dual_system.models.ponder.network import Ponder
from dual_system.models.second_look import SecondLook
from dual_system.models.specialty import Specialty
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.runner import Session
from tests.ponder_server.test_engine import CONFIG, TOLERANCE, WITH_DEMO, WITHOUT_DEMO, observation, untrained

COUNTING = Specialty(name="counting", instructions="count")
COUNTED = Opening(instruction="count the buttons")
NUM_QUERIES = 3


def specialised() -> Ponder:
    ponder = untrained()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for weight in ponder.add_specialist(COUNTING).parameters():
            weight.mul_(1 + 0.1 * torch.randn(weight.shape, generator=generator))
    return ponder


def as_everybody() -> Ponder:
    """The specialist's weights are all that there are."""
    ponder, alone = specialised(), untrained()
    given = dict(alone.qwen.model.language_model.named_parameters())
    with torch.no_grad():
        for name, weight in ponder.specialists["counting"].named_parameters():
            given[name].copy_(weight)
    return alone


def cognitions(ponder: Ponder, opening: Opening) -> list[np.ndarray]:
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", opening)
    return [engine.fire("a", observation(query)).cognition for query in range(NUM_QUERIES)]


@pytest.mark.parametrize("buckets", [(1, 16, 160), (512,)])
def test_each_session_is_read_by_its_own_weights(buckets: tuple[int, ...]) -> None:
    engine = QwenEngine(specialised(), replace(CONFIG, buckets=buckets))
    expected = {"counted": cognitions(as_everybody(), COUNTED), "plain": cognitions(untrained(), WITHOUT_DEMO)}
    engine.open("counted", COUNTED)
    engine.open("plain", WITHOUT_DEMO)
    for query in range(NUM_QUERIES):
        for session in expected:
            engine.begin(session, observation(query))
        waiting = set(expected)
        while waiting:
            for outcome in engine.step():
                waiting.remove(outcome.session)
                wanted = expected[outcome.session][query]
                assert np.abs(outcome.unwrap().cognition - wanted).max() < TOLERANCE
    by_others = cognitions(untrained(), COUNTED)
    assert all(np.abs(x - y).max() > TOLERANCE for x, y in zip(by_others, expected["counted"], strict=True))


def test_after_a_demonstration_it_goes_on_from_what_the_reader_leaves() -> None:
    ponder = specialised()
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for weight in ponder.add_reader().parameters():
            weight.mul_(1 + 0.1 * torch.randn(weight.shape, generator=generator))
    shown = replace(WITH_DEMO, instruction=COUNTED.instruction)
    form = ponder.format
    queries = [segment for _ in range(NUM_QUERIES) for segment in form.query(2, None)]
    row = form.row([*form.opening(shown.instruction, [len(views) for views in shown.demo_frames]), *queries])
    frames = [frame for views in shown.demo_frames for frame in views]
    frames += [frame for query in range(NUM_QUERIES) for frame in observation(query)]
    positions = torch.from_numpy(form.positions(row.ids)[0])[:, None]
    embeds = ponder.embed(row.ids, torch.from_numpy(np.stack(frames)))[None]
    specialist: Any = ponder.specialists["counting"]
    with torch.inference_mode():
        read, by_everybody = (ponder(embeds, positions, [row.num_shown], each)[0] for each in (specialist, None))
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", shown)
    for query, carriers in enumerate(torch.from_numpy(row.carrier_index)):
        cognition = torch.from_numpy(engine.fire("a", observation(query)).cognition)
        assert (cognition - read[carriers]).abs().max() < TOLERANCE
        assert ((cognition - by_everybody[carriers]).abs().max() < TOLERANCE) == (query == 0), (
            "the first is the reader's"
        )


def test_an_answer_that_is_taken_back_is_the_specialists_once_more() -> None:
    engine = QwenEngine(specialised(), CONFIG)
    engine.open("a", COUNTED)
    first = engine.fire("a", observation(0)).cognition
    engine.undo("a")
    assert np.array_equal(engine.fire("a", observation(0)).cognition, first)


def test_a_second_look_is_the_specialists_too(monkeypatch: pytest.MonkeyPatch) -> None:
    ponder = specialised()
    ponder.format = replace(ponder.format, second_look=SecondLook(after=2, least=8))
    engine = QwenEngine(ponder, CONFIG)
    readers = []
    opened = engine._runner.open

    def open_(name: str, text_model: object = None) -> Session:
        readers.append(text_model)
        return opened(name, text_model)

    monkeypatch.setattr(engine._runner, "open", open_)
    monkeypatch.setattr(engine._writer, "wants_to_write", lambda hidden: False)
    engine.open("a", COUNTED)
    engine.begin("a", observation(0), saying=("go to [101, 200] now",))
    engine.step()
    while engine._begun or engine._batch:
        engine.step()
    for query in range(1, 4):
        engine.fire("a", observation(query))
    assert len(readers) > 1, "it has looked again"
    assert all(each is ponder.specialists["counting"] for each in readers)


def test_narrow_weights_are_the_specialists_too() -> None:
    ponder = specialised()
    QwenEngine(ponder, replace(CONFIG, weights="int8"))
    assert any(isinstance(module, Int8Linear) for module in ponder.specialists.modules())
