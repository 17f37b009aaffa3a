"""A second look: due when words have stood, taken apart from the episode's context, and told as if said by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.context import Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.second_look import SecondLook
from ponder_server.engine import QwenEngine
from ponder_server.standing import Standing
from tests.ponder_server.test_engine import (
    CONFIG,
    INSTRUCTION,
    TOLERANCE,
    VOCABULARY,
    WITH_DEMO,
    WITHOUT_DEMO,
    Script,
    assert_untouched,
    context_of,
    encode,
    frame,
    observation,
    state_of,
    training_row,
    untrained,
)

LOOK = SecondLook(after=2, least=8, unless="hides")
SAID, ELSEWHERE, SAME = (VOCABULARY.encode(f"go to [10{n}, 200] now") for n in (1, 9, 2))
SILENT: Script = (Transition(subgoal=SAID), None, None)


def taught_to_look_again(anew: tuple[int, ...], look: SecondLook = LOOK) -> Ponder:
    """Says `SAID` at once and nothing after it; asked in a context of its own what it sees third, it says ``anew``."""
    ponder = untrained()
    form = ponder.format = replace(ponder.format, second_look=look)
    row = training_row(ponder, SILENT)
    alone = form.row([*form.opening(INSTRUCTION), *form.query(2, Transition(subgoal=anew))])
    with torch.inference_mode():
        looked_TH = ponder.encode_row(alone, torch.from_numpy(np.stack(observation(2))))
    hidden, targets = [], []
    for each, hidden_TH in ((row, encode(ponder, row)), (alone, looked_TH)):
        index = torch.from_numpy(each.supervised_index)
        hidden.append(hidden_TH[index].double())
        targets.append(torch.tensor(each.targets)[index + 1])
    hidden_NH = torch.cat(hidden)
    assert len(hidden_NH) < ponder.hidden_size, "more targets than the head can fit exactly"
    wanted_NV = 10.0 * torch.nn.functional.one_hot(torch.cat(targets), ponder.vocab_size).double()
    with torch.no_grad():
        ponder.qwen.lm_head.weight.copy_((torch.linalg.pinv(hidden_NH) @ wanted_NV).T)
    return ponder


def assert_is_row(engine: QwenEngine, ponder: Ponder, script: Script) -> None:
    """The session's context and its newest cognition are those of the training row of these words."""
    row = training_row(ponder, script)
    assert context_of(engine, "a").ids == list(row.ids)
    assert context_of(engine, "a").next_position == ponder.format.positions(row.ids)[1]


def test_another_place_is_said_as_if_it_had_been_said_by_itself() -> None:
    ponder = taught_to_look_again(ELSEWHERE)
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITH_DEMO)
    answers = [engine.fire("a", observation(query)) for query in range(3)]
    assert [[text.text for text in each.texts] for each in answers] == [
        ["go to [101, 200] now"],
        [],
        ["go to [109, 200] now"],
    ]
    assert answers[2].is_transition
    script: Script = (SILENT[0], None, Transition(subgoal=ELSEWHERE))
    assert_is_row(engine, ponder, script)
    row = training_row(ponder, script)
    expected = encode(ponder, row)[torch.from_numpy(row.carrier_index)]
    for answer, C_t in zip(answers, expected, strict=True):
        assert np.abs(answer.cognition - C_t.numpy()).max() < TOLERANCE


@pytest.mark.parametrize(("anew", "look"), [(SAME, LOOK), (ELSEWHERE, replace(LOOK, unless="go t")), (ELSEWHERE, None)])
def test_the_same_place_or_what_only_memory_knows_leaves_silence(
    anew: tuple[int, ...], look: SecondLook | None
) -> None:
    ponder = taught_to_look_again(anew)
    ponder.format = replace(ponder.format, second_look=look)
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITH_DEMO)
    answers = [engine.fire("a", observation(query)) for query in range(3)]
    assert [len(each.texts) for each in answers] == [1, 0, 0]
    assert_is_row(engine, ponder, SILENT)


def test_a_second_look_that_fails_leaves_no_trace_and_is_taken_by_the_next_query(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ponder = taught_to_look_again(ELSEWHERE)
    engine = QwenEngine(ponder, replace(CONFIG, max_sessions=1))
    engine.open("a", WITH_DEMO)
    for query in range(2):
        engine.fire("a", observation(query))
    before = state_of(context_of(engine, "a"))
    with monkeypatch.context() as broken:
        broken.setattr(np, "isfinite", lambda values: np.zeros(values.shape, np.bool_))
        with pytest.raises(FloatingPointError, match="cognition is not finite"):
            engine.fire("a", observation(2))
    assert_untouched(context_of(engine, "a"), before)
    assert [text.text for text in engine.fire("a", observation(2)).texts] == ["go to [109, 200] now"]
    engine.close("a")
    engine.open("a", WITHOUT_DEMO)  # and the place of its own context is free again


def test_a_session_dropped_in_the_middle_of_a_second_look_gives_both_places_back() -> None:
    ponder = taught_to_look_again(ELSEWHERE)
    engine = QwenEngine(ponder, replace(CONFIG, max_sessions=1))
    for _ in range(3):
        engine.open("a", WITH_DEMO)
        for query in range(2):
            engine.fire("a", observation(query))
        engine.begin("a", observation(2))
        engine.step()
        assert not engine.step()
        engine.close("a")


def test_sessions_look_again_at_once() -> None:
    ponder = taught_to_look_again(ELSEWHERE)
    engine = QwenEngine(ponder, replace(CONFIG, max_sessions=2))
    for session in ("a", "b"):
        engine.open(session, WITH_DEMO)
        for query in range(2):
            engine.fire(session, observation(query))
    for session in ("a", "b"):
        engine.begin(session, observation(2))
    found = {}
    while len(found) < 2:
        found |= {outcome.session: outcome.unwrap() for outcome in engine.step()}
    assert {each.texts[0].text for each in found.values()} == {"go to [109, 200] now"}


def test_words_without_a_place_are_not_completed() -> None:
    """Of a text whose place never closes, or has none, nothing is made."""
    ponder = taught_to_look_again(ELSEWHERE)
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITHOUT_DEMO)
    context = context_of(engine, "a")
    ids = ponder.format.observation(2).ids
    embeds_TH = engine._embed(ids, [frame(0), frame(1)])
    for text in ("go on", "go to [1", "go to 1]"):
        steps = engine._writer.complete_place(context, ids, embeds_TH, VOCABULARY.encode(text))
        with pytest.raises(StopIteration) as stop:
            next(steps)
        assert stop.value.value == VOCABULARY.encode(text)


EVENTS = st.lists(
    st.sampled_from(["silent", "pick [1, 2]", "pick [50, 2]", "drop [1, 2]", "rest", "what hides [1, 2]"])
)


@given(events=EVENTS, after=st.integers(1, 5))
def test_it_is_due_when_words_about_a_place_have_stood_and_not_before(events: list[str], after: int) -> None:
    standing = Standing(replace(LOOK, after=after))
    about, since = "", 0
    for event in events:
        since += 1
        can_tell = "[" in about and "hides" not in about
        assert standing.is_due == (can_tell and since >= after)
        is_look = event == "silent" and standing.is_due
        texts = [] if event == "silent" else [(event, (1, 2))]
        standing.answered(texts, looked_again=is_look)
        if is_look or (texts and event.split("[")[0] != about.split("[")[0]):
            since = 0
        about = event if texts else about
    assert standing.text == about


@given(
    place=st.tuples(st.integers(0, 999), st.integers(0, 999)),
    move=st.tuples(st.integers(-20, 20), st.integers(-20, 20)),
)
def test_what_is_nearer_than_the_least_is_the_same_place(place: tuple[int, int], move: tuple[int, int]) -> None:
    (x, y), (dx, dy) = place, move
    moved = abs(x + dx), abs(y + dy)
    is_far = (moved[0] - x) ** 2 + (moved[1] - y) ** 2 >= 64
    assert LOOK.is_another(f"go to [{x}, {y}], [1, 1]", f"go to [{moved[0]}, {moved[1]}], [900, 900]") == is_far
    assert not LOOK.is_another("go", f"go [{x}, {y}]")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [({"after": 0}, "at least 1 query"), ({"least": 0}, "1 thousandth"), ({"unless": "("}, "no regular")],
)
def test_a_second_look_that_makes_no_sense_is_refused(wrong: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        replace(LOOK, **wrong)  # type: ignore[arg-type]
