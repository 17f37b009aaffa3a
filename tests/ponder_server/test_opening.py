"""Openings of a PONDER that takes notes: the training row's, refused where they do not fit, none without words."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.context import SegmentKind, Transition
from ponder_server.contract import ContextFull
from ponder_server.engine import QwenEngine
from tests.ponder_server.test_engine import (
    CONFIG,
    INSTRUCTION,
    SUBGOAL,
    TOLERANCE,
    VOCABULARY,
    WITH_DEMO,
    WITHOUT_DEMO,
    Script,
    context_of,
    encode,
    observation,
    taught,
    training_row,
)

NOTES: Script = (None, Transition(subgoal=VOCABULARY.encode("at <1, 2>")), Transition(subgoal=VOCABULARY.encode("<3>")))
NOTING_SCRIPT: Script = (None, Transition(subgoal=SUBGOAL))


@pytest.mark.parametrize("prefill_chunk_tokens", [1, 4096])
def test_serving_regenerates_the_row_of_a_ponder_that_takes_notes(prefill_chunk_tokens: int) -> None:
    """Also from an equal demonstration of before; and where a context is to forget, notes stay as their pictures do."""
    ponder = taught(NOTING_SCRIPT, notes=NOTES)
    row = training_row(ponder, NOTING_SCRIPT, notes=NOTES)
    engine = QwenEngine(ponder, replace(CONFIG, prefill_chunk_tokens=prefill_chunk_tokens))
    expected = encode(ponder, row)[torch.from_numpy(row.carrier_index)]
    num_opened = len(ponder.format.row(ponder.format.opening(INSTRUCTION, [1, 1, 1], NOTES)).ids)
    for session in ("a", "b"):
        assert engine.open(session, WITH_DEMO) == num_opened
        spans = engine._episode(session).spans
        assert sum(span.num_tokens for span in spans) == num_opened
        assert {span.kind for span in spans} == {SegmentKind.INSTRUCTION, SegmentKind.DEMO, SegmentKind.EXECUTION}
        answers = [engine.fire(session, observation(query)) for query in range(len(NOTING_SCRIPT))]
        assert context_of(engine, session).ids == list(row.ids)
        assert context_of(engine, session).next_position == ponder.format.positions(row.ids)[1]
        for answer, C_t in zip(answers, expected, strict=True):
            assert np.abs(answer.cognition - C_t.numpy()).max() < TOLERANCE
        told = [(note.instant, note.text.text) for note in answers[0].notes]
        assert told == [(1, "at <1, 2>"), (2, "<3>")], "each with the instant that it is of, and with the first answer"
        assert not any(answer.notes for answer in answers[1:])


def test_a_query_that_fails_leaves_notes_to_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = QwenEngine(taught(NOTING_SCRIPT, notes=NOTES), CONFIG)
    engine.open("a", WITH_DEMO)
    with monkeypatch.context() as broken:
        broken.setattr(np, "isfinite", lambda values: np.zeros(values.shape, np.bool_))
        with pytest.raises(FloatingPointError, match="cognition is not finite"):
            engine.fire("a", observation(0))
    assert len(engine.fire("a", observation(0)).notes) == 2
    assert not engine.fire("a", observation(1)).notes


def test_notes_that_do_not_fit_refuse_the_session_and_leave_its_place_free() -> None:
    ponder = taught(NOTING_SCRIPT, notes=NOTES)
    num_opened = len(ponder.format.row(ponder.format.opening(INSTRUCTION, [1, 1, 1], NOTES)).ids)
    engine = QwenEngine(ponder, replace(CONFIG, max_context_tokens=num_opened - 1, max_sessions=1))
    with pytest.raises(ContextFull):
        engine.open("a", WITH_DEMO)
    engine.open("a", WITHOUT_DEMO)


def test_a_ponder_without_words_takes_no_notes() -> None:
    ponder = taught(NOTING_SCRIPT, notes=NOTES)
    ponder.format = replace(ponder.format, speaks=False)
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITH_DEMO)
    assert context_of(engine, "a").ids == list(training_row(ponder, ()).ids)
