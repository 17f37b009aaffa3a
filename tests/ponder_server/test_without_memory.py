"""A PONDER without memory: whatever a session saw before, it answers as a fresh one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import ContextFull, EngineSpec, Fire, Frame, Opening, Text
from ponder_server.draft import TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.node import PonderNode, Work
from ponder_server.writer import TransitionWriter
from protocol import messages as m

CONFIG = EngineConfig(num_cameras=2, max_context_tokens=120, max_sessions=3, max_text_tokens=6)
INSTRUCTION = "press the buttons in order"


def frame(seed: int) -> Frame:
    return np.random.default_rng(seed).integers(0, 256, (32, 32, 3), dtype=np.uint8)


def observation(seed: int) -> tuple[Frame, ...]:
    return frame(100 + 2 * seed), frame(101 + 2 * seed)


WITHOUT_DEMO = Opening(instruction=INSTRUCTION)
WITH_DEMO = Opening(instruction=INSTRUCTION, demo_frames=tuple((frame(i),) for i in range(3)))


def ponder_that(*, remembers: bool) -> Ponder:
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4, num_carriers=2), seed=1)
    ponder.format = replace(ponder.format, remembers=remembers)
    return ponder


PONDER = ponder_that(remembers=False)


@pytest.fixture(autouse=True)
def writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Untrained weights hardly ever begin a text: here they do at two of three pictures."""

    def gate(_: TransitionWriter, hidden_1H: object) -> tuple[bool, float]:
        score = float(abs(hidden_1H.sum()) * 1000 % 1)  # type: ignore[attr-defined]
        return score > 1 / 3, score

    monkeypatch.setattr(TransitionWriter, "gate", gate)


def answer(engine: QwenEngine, session: str, seed: int) -> Fire:
    return engine.fire(session, observation(seed))


def assert_alike(one: Fire, other: Fire) -> None:
    assert np.array_equal(one.cognition, other.cognition)
    assert (one.texts, one.gate_score, one.context_tokens) == (other.texts, other.gate_score, other.context_tokens)
    assert one.is_transition == other.is_transition


HISTORIES = st.lists(st.tuples(st.integers(0, 5), st.sampled_from([None, 1, 3])), max_size=5)


@pytest.mark.parametrize("has_draft", [pytest.param(False, marks=pytest.mark.acceptance), True])
@given(history=HISTORIES, seed=st.integers(0, 5), opening=st.sampled_from([WITHOUT_DEMO, WITH_DEMO]))
@settings(max_examples=15)
def test_every_answer_is_that_of_a_fresh_session(
    has_draft: bool, history: list[tuple[int, int | None]], seed: int, opening: Opening
) -> None:
    engine = engine_with(has_draft)
    engine.open("old", opening)
    engine.open("fresh", WITHOUT_DEMO)
    for earlier, forced in history:
        engine.fire("old", observation(earlier), force_text_tokens=forced)
    assert_alike(answer(engine, "old", seed), answer(engine, "fresh", seed))
    for session in ("old", "fresh"):
        engine.close(session)


@cache
def engine_with(has_draft: bool) -> QwenEngine:
    """One engine for all histories, with a draft that is right about three tokens of a text."""
    engine = QwenEngine(PONDER, CONFIG)
    if not has_draft:
        return engine
    engine.open("a", WITHOUT_DEMO)
    greedy = next(text.token_ids for seed in range(9) for text in answer(engine, "a", seed).texts)
    return QwenEngine(PONDER, CONFIG, TrieDraft([(*greedy[:3], 7)]))


def test_with_memory_none_of_this_holds_and_without_it_pictures_still_decide() -> None:
    with_memory, without = (QwenEngine(ponder_that(remembers=each), CONFIG) for each in (True, False))
    found = {}
    for name, engine in (("with", with_memory), ("without", without)):
        engine.open("a", WITHOUT_DEMO)
        found[name] = [answer(engine, "a", seed) for seed in (0, 1, 0)]
    assert not np.array_equal(found["with"][0].cognition, found["with"][2].cognition)
    assert np.array_equal(found["without"][0].cognition, found["without"][2].cognition)
    assert not np.array_equal(found["without"][0].cognition, found["without"][1].cognition)
    assert {bool(answer(without, "a", seed).texts) for seed in range(9)} == {True, False}


def test_a_demonstration_is_not_read_and_no_reasoning_written() -> None:
    engine = QwenEngine(PONDER, CONFIG)
    assert engine.open("shown", WITH_DEMO) == engine.open("a", WITHOUT_DEMO)
    assert {text.kind for seed in range(9) for text in answer(engine, "shown", seed).texts} == {"subgoal"}
    assert not engine.spec.remembers


def test_sessions_in_common_forwards_keep_apart() -> None:
    engine = QwenEngine(PONDER, CONFIG)
    for session in ("a", "b", "alone"):
        engine.open(session, WITHOUT_DEMO)
    for seed in range(6):
        engine.begin("a", observation(seed))
        engine.begin("b", observation(seed + 1))
        answers: dict[str, Fire] = {}
        while len(answers) < 2:
            answers |= {outcome.session: outcome.unwrap() for outcome in engine.step()}
        for session, shown in (("a", seed), ("b", seed + 1)):
            alone = answer(engine, "alone", shown)
            np.testing.assert_allclose(answers[session].cognition, alone.cognition, atol=1e-4)
            assert answers[session].texts == alone.texts


def test_a_context_never_fills() -> None:
    probe = QwenEngine(PONDER, CONFIG)
    needed = probe.open("a", WITHOUT_DEMO) + 2 * 3 + 2 + 1 + CONFIG.max_text_tokens
    engine = QwenEngine(PONDER, replace(CONFIG, max_context_tokens=needed))
    engine.open("a", WITHOUT_DEMO)
    used = [answer(engine, "a", seed).context_tokens for seed in range(25)]
    assert max(used) == needed
    assert len(engine.warm_up_full()) >= 10
    tight = QwenEngine(PONDER, replace(CONFIG, max_context_tokens=needed - CONFIG.max_text_tokens - 2))
    tight.open("a", WITHOUT_DEMO)
    with pytest.raises(ContextFull, match=f"the limit is {needed - CONFIG.max_text_tokens - 2}"):
        answer(tight, "a", 0)


@pytest.mark.parametrize("call", [1, 2, 5])
def test_an_interrupted_query_leaves_no_trace(call: int) -> None:
    engine = QwenEngine(PONDER, CONFIG)
    engine.open("a", WITHOUT_DEMO)
    calls = iter(range(1, 1000))

    def interrupt() -> None:
        if next(calls) == call:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        engine.fire("a", observation(3), interrupt)
    engine.open("fresh", WITHOUT_DEMO)
    assert_alike(answer(engine, "a", 1), answer(engine, "fresh", 1))


SPEC = EngineSpec(
    num_carriers=1, hidden_size=4, image_px=(4, 6), num_cameras=2, max_context_tokens=100, model_hash="abc",
    is_random=True, dtype="float32", remembers=False,
)  # fmt: skip


def told(node: PonderNode, query: int, text: str | None) -> m.Cognition:
    texts = () if text is None else (Text(kind="subgoal", text=text, token_ids=(1,), truncated=False),)
    fire = Fire(cognition=np.ones((1, 4), np.float32), is_transition=bool(texts), texts=texts, context_tokens=9)
    asked = m.Query(query=query, tick=query, source_ns=100 * query + 1)
    work = Work(query=asked, frames=(), proprio=np.zeros(8, np.float32))
    cognition, subgoals = node.answer(work, fire, ready_ns=1000, infer_ns=1)
    assert [each.text for each in subgoals] == ([] if text is None else [text])
    return cognition


@given(texts=st.lists(st.sampled_from([None, "press", "pick"]), max_size=12))
def test_a_text_is_of_its_own_query_and_a_transition_only_if_it_differs(texts: list[str | None]) -> None:
    node = PonderNode(SPEC)
    node.open()
    before = ""
    for query, text in enumerate(texts):
        cognition = told(node, query, text)
        assert cognition.text == (text or "")
        assert cognition.text_source_ns == (cognition.source_ns if text else 0)
        assert cognition.is_transition == (text is not None and text != before)
        before = text or ""


def test_with_memory_the_same_words_may_be_a_new_subgoal() -> None:
    node = PonderNode(replace(SPEC, remembers=True))
    node.open()
    assert [told(node, query, text).is_transition for query, text in enumerate(["press", "press", None])] == [
        True,
        True,
        False,
    ]
