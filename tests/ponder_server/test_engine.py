"""The engine: a fire is one query of the training row, whatever path it took; errors leave no trace."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import ContextFull, Frame, Opening, SessionError
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.runner import Append, Runner, Session

TOLERANCE = 1e-4
VOCABULARY = Vocabulary.tiny()
MODEL = replace(tiny_cpu(), image_px=(64, 64), num_carriers=2)
CONFIG = EngineConfig(num_cameras=2, max_context_tokens=400, max_sessions=3)
HEARD = MODEL.num_layers + 1  # signs of life of a forward: its layers, and its end
SEEN = MODEL.vision_depth  # and of the vision tower, however many pictures at once
INSTRUCTION = "press the buttons in order"
REASONING = VOCABULARY.encode("left, then right, then the left")
SUBGOAL = VOCABULARY.encode("press the left button")
SUBGOAL_2 = VOCABULARY.encode("press the right one")
Script = tuple[Transition | None, ...]
SCRIPT: Script = (
    None,
    Transition(subgoal=SUBGOAL, reasoning=REASONING),
    None,
    Transition(subgoal=SUBGOAL_2),
)


def frame(seed: int) -> Frame:
    return np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8)


def observation(query: int) -> tuple[Frame, ...]:
    return frame(100 + 2 * query), frame(101 + 2 * query)


DEMO = tuple((frame(i),) for i in range(3))
WITH_DEMO = Opening(instruction=INSTRUCTION, demo_frames=DEMO)
WITHOUT_DEMO = Opening(instruction=INSTRUCTION)


def untrained() -> Ponder:
    return Ponder.random(MODEL, VOCABULARY, seed=1)


def training_row(ponder: Ponder, transitions: Script, opening: Opening = WITH_DEMO) -> Row:
    form = ponder.format
    queries = [segment for transition in transitions for segment in form.query(2, transition)]
    return form.row([*form.opening(INSTRUCTION, [len(views) for views in opening.demo_frames]), *queries])


def encode(ponder: Ponder, row: Row, opening: Opening = WITH_DEMO) -> torch.Tensor:
    frames = [f for views in opening.demo_frames for f in views]
    frames += [f for query in range(len(row.carrier_index)) for f in observation(query)]
    with torch.inference_mode():
        return ponder.encode_row(row, torch.from_numpy(np.stack(frames)))


def taught(script: Script, opening: Opening = WITH_DEMO) -> Ponder:
    """A PONDER whose LM head is fitted to one row's targets by least squares: trained, without training."""
    ponder = untrained()
    row = training_row(ponder, script, opening)
    hidden_NH = encode(ponder, row, opening)[torch.from_numpy(row.supervised_index)].double()
    targets = torch.tensor(row.targets)[torch.from_numpy(row.supervised_index + 1)]
    assert len(hidden_NH) < ponder.hidden_size, "more targets than the head can fit exactly"
    wanted_NV = 10.0 * torch.nn.functional.one_hot(targets, ponder.vocab_size).double()
    with torch.no_grad():
        ponder.qwen.lm_head.weight.copy_((torch.linalg.pinv(hidden_NH) @ wanted_NV).T)
    return ponder


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return taught(SCRIPT)


@pytest.fixture
def engine(ponder: Ponder) -> QwenEngine:
    return QwenEngine(ponder, CONFIG)


def context_of(engine: QwenEngine, session: str) -> Session:
    return engine._episode(session).context


def state_of(context: Session) -> tuple[list[int], int, list[torch.Tensor]]:
    saved = context.save()
    return list(context.ids), saved.next_position, saved.tensors


def assert_untouched(context: Session, before: tuple[list[int], int, list[torch.Tensor]]) -> None:
    ids, next_position, tensors = state_of(context)
    assert (ids, next_position) == before[:2]
    assert all(torch.equal(now, then) for now, then in zip(tensors, before[2], strict=True))


def test_serving_regenerates_the_training_row(ponder: Ponder, engine: QwenEngine) -> None:
    row = training_row(ponder, SCRIPT)
    engine.open("a", WITH_DEMO)
    answers = [engine.fire("a", observation(query)) for query in range(len(SCRIPT))]
    assert context_of(engine, "a").ids == list(row.ids)
    assert context_of(engine, "a").next_position == ponder.format.positions(row.ids)[1]
    assert [a.is_transition for a in answers] == [False, True, False, True]
    assert [round(a.gate_score or 0, 2) for a in answers] == [0, 1, 0, 1]
    assert [(t.kind, t.token_ids, t.truncated) for t in answers[1].texts] == [
        ("demo_reasoning", REASONING, False),
        ("subgoal", SUBGOAL, False),
    ]
    assert [t.text for t in answers[3].texts] == ["press the right one"]
    expected = encode(ponder, row)[torch.from_numpy(row.carrier_index)]
    for answer, C_t in zip(answers, expected, strict=True):
        assert answer.cognition.dtype == np.float32
        assert np.abs(answer.cognition - C_t.numpy()).max() < TOLERANCE
    assert answers[-1].context_tokens == len(row.ids)


def test_serving_regenerates_the_row_of_a_ponder_that_was_trained_without_texts() -> None:
    """Its LM head is untrained: here it predicts T_yes wherever it is run."""
    ponder = taught(SCRIPT)
    ponder.format = replace(ponder.format, speaks=False)
    silence: Script = (None,) * len(SCRIPT)
    row = training_row(ponder, silence)
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITH_DEMO)
    answers = [engine.fire("a", observation(query)) for query in range(len(silence))]
    assert context_of(engine, "a").ids == list(row.ids)
    assert [(each.is_transition, each.texts, each.gate_score) for each in answers] == [(False, (), None)] * len(silence)
    expected = encode(ponder, row)[torch.from_numpy(row.carrier_index)]
    for answer, C_t in zip(answers, expected, strict=True):
        assert np.abs(answer.cognition - C_t.numpy()).max() < TOLERANCE


def test_a_transition_has_forgotten_its_speculative_carriers_to_the_last_bit(engine: QwenEngine) -> None:
    engine.open("a", WITH_DEMO)
    engine.open("b", WITH_DEMO)
    engine.fire("a", observation(0))
    engine.fire("b", observation(0))
    by_engine = engine.fire("a", observation(1))

    form, ponder, context = engine._format, engine._ponder, engine._episode("b").context
    t_yes = VOCABULARY.t_yes
    with torch.inference_mode():
        ids = form.observation(2).ids
        context.append(ids, ponder.embed(ids, torch.from_numpy(np.stack(observation(1)))))
        for token in (t_yes, *REASONING, t_yes, *SUBGOAL):
            context.append([token], ponder.embed([token]))
        by_hand = context.append(form.carrier_ids, ponder.embed(form.carrier_ids))
    np.testing.assert_array_equal(by_engine.cognition, by_hand.numpy())


def test_a_transition_appends_its_observation_once(ponder: Ponder, engine: QwenEngine) -> None:
    """Each token of the row goes through the network once, and the carriers twice: they are read ahead of the text."""
    lengths = []
    append = engine._runner.append

    def count(appends: Sequence[Append]) -> list[torch.Tensor]:
        lengths.extend(len(one.ids) for one in appends)
        return append(appends)

    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine._runner, "append", count)
        assert engine.fire("a", observation(1)).texts
    assert lengths == [12 + 2, *[1] * (1 + len(REASONING) + 1 + len(SUBGOAL)), 2]


def test_equal_sessions_give_equal_bits_also_interleaved_and_reopened(engine: QwenEngine) -> None:
    queries = range(len(SCRIPT))
    engine.open("alone", WITH_DEMO)
    alone = [engine.fire("alone", observation(q)).cognition for q in queries]
    engine.close("alone")
    engine.open("x", WITH_DEMO)
    engine.open("other", WITHOUT_DEMO)
    interleaved = []
    for q in queries:
        engine.fire("other", observation(q + 50), force_text_tokens=3)
        interleaved.append(engine.fire("x", observation(q)).cognition)
    np.testing.assert_array_equal(interleaved, alone)


def test_demo_reasoning_is_written_at_the_first_transition_only() -> None:
    script = (None, Transition(subgoal=REASONING), Transition(subgoal=SUBGOAL))
    engine = QwenEngine(taught(script), CONFIG)
    engine.open("a", WITH_DEMO)
    texts = [engine.fire("a", observation(query)).texts for query in range(3)]
    # T_no right after the reasoning ends the whole transition; it is not asked for again
    assert [[(t.kind, t.token_ids) for t in ts] for ts in texts] == [
        [],
        [("demo_reasoning", REASONING)],
        [("subgoal", SUBGOAL)],
    ]


def test_without_a_demo_the_first_transition_is_a_subgoal() -> None:
    engine = QwenEngine(taught((Transition(subgoal=SUBGOAL),), WITHOUT_DEMO), CONFIG)
    engine.open("a", WITHOUT_DEMO)
    assert [(t.kind, t.text) for t in engine.fire("a", observation(0)).texts] == [("subgoal", "press the left button")]


@pytest.mark.parametrize("max_text_tokens", [len(REASONING), len(REASONING) - 1])
def test_a_text_is_truncated_only_if_it_would_have_gone_on(ponder: Ponder, max_text_tokens: int) -> None:
    assert len(SUBGOAL) <= len(REASONING) - 1
    config = replace(CONFIG, max_text_tokens=max_text_tokens)
    engine = QwenEngine(ponder, config)
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    reasoning, subgoal = engine.fire("a", observation(1)).texts
    assert reasoning.truncated == (max_text_tokens < len(REASONING))
    assert reasoning.token_ids == REASONING[:max_text_tokens]
    assert subgoal.kind == "subgoal"  # S follows a truncated DR all the same
    ids = context_of(engine, "a").ids
    payload = (VOCABULARY.t_yes, *reasoning.token_ids, VOCABULARY.t_yes, *subgoal.token_ids)
    assert tuple(ids[-2 - len(payload) : -2]) == payload


def test_text_leaves_room_for_the_carriers(ponder: Ponder) -> None:
    opened = QwenEngine(ponder, CONFIG).open("a", WITH_DEMO)
    ordinary, text = 12 + 2, 1 + len(REASONING) + 1 + 3
    limit = opened + 2 * ordinary + text
    engine = QwenEngine(ponder, replace(CONFIG, max_context_tokens=limit))
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    answer = engine.fire("a", observation(1))
    assert [(t.token_ids, t.truncated) for t in answer.texts] == [(REASONING, False), (SUBGOAL[:3], True)]
    assert answer.context_tokens == limit


@pytest.mark.parametrize("room_for_text", [0, 2])
def test_a_transition_that_does_not_fit_leaves_no_trace(ponder: Ponder, room_for_text: int) -> None:
    opened = QwenEngine(ponder, CONFIG).open("a", WITH_DEMO)
    limit = opened + 2 * (12 + 2) + room_for_text
    engine = QwenEngine(ponder, replace(CONFIG, max_context_tokens=limit))
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    before = state_of(context_of(engine, "a"))
    needed = 12 + 1 + 1 + 2 + 2  # observation, T_yes, a token of DR, T_yes and a token of S, carriers
    with pytest.raises(ContextFull, match=f"holds {opened + 14} tokens and needs {needed} more, the limit is {limit}"):
        engine.fire("a", observation(1))
    assert_untouched(context_of(engine, "a"), before)


@pytest.mark.parametrize("call", [1, 2, 5])
def test_a_fire_that_is_interrupted_leaves_no_trace(engine: QwenEngine, call: int) -> None:
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    before = state_of(context_of(engine, "a"))
    calls = iter(range(1, 1000))

    def interrupt() -> None:
        if next(calls) == call:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        engine.fire("a", observation(1), interrupt)
    assert_untouched(context_of(engine, "a"), before)
    assert [t.kind for t in engine.fire("a", observation(1)).texts] == ["demo_reasoning", "subgoal"]


def test_progress_is_heard_at_every_chunk_and_every_token(ponder: Ponder) -> None:
    engine = QwenEngine(ponder, replace(CONFIG, prefill_chunk_tokens=1))
    calls: list[int] = []
    engine.open("a", WITH_DEMO, lambda: calls.append(0))
    assert len(calls) == (1 + len(DEMO) + 1) * HEARD + len(DEMO) * SEEN
    engine.fire("a", observation(0), lambda: calls.append(1))
    assert calls.count(1) == HEARD + SEEN
    engine.fire("a", observation(1), lambda: calls.append(2))
    # one-pass try, T_yes, each token, T_yes between the texts, carriers
    assert calls.count(2) == (1 + 1 + len(REASONING) + 1 + len(SUBGOAL) + 1) * HEARD + SEEN


def test_the_chunks_of_the_opening_do_not_matter(ponder: Ponder) -> None:
    answers = []
    for prefill_chunk_tokens in (1, 20, 512):
        config = replace(CONFIG, prefill_chunk_tokens=prefill_chunk_tokens)
        engine = QwenEngine(ponder, config)
        engine.open("a", WITH_DEMO)
        answers.append(engine.fire("a", observation(0)).cognition)
    np.testing.assert_allclose(answers[1:], [answers[0]] * 2, rtol=0, atol=TOLERANCE)


def test_a_demonstration_is_encoded_once_and_shared(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = QwenEngine(ponder, CONFIG)
    num_encoded = []
    embed = ponder.embed

    def count(ids: Sequence[int], *pictures: torch.Tensor) -> torch.Tensor:
        num_encoded.append(len(ids))
        return embed(ids, *pictures)

    monkeypatch.setattr(ponder, "embed", count)
    num_tokens = engine.open("a", WITH_DEMO)
    assert sum(num_encoded) == num_tokens
    first = engine.fire("a", observation(0))
    num_encoded.clear()
    assert engine.open("b", WITH_DEMO) == num_tokens
    assert num_encoded == []
    np.testing.assert_array_equal(engine.fire("b", observation(0)).cognition, first.cognition)
    engine.open("c", replace(WITH_DEMO, demo_frames=(*DEMO[:-1], (frame(77),))))
    assert len(num_encoded) > 1, "another demonstration must not be taken for this one"
    assert np.abs(engine.fire("c", observation(0)).cognition - first.cognition).max() > TOLERANCE


def test_a_long_demonstration_takes_a_few_forwards(ponder: Ponder) -> None:
    """48 s of two views at 1 Hz; never frame by frame."""
    engine = QwenEngine(ponder, replace(CONFIG, max_context_tokens=1000))
    calls: list[int] = []
    demo = tuple((frame(2 * i), frame(2 * i + 1)) for i in range(48))
    assert engine.open("a", Opening(instruction="x", demo_frames=demo), lambda: calls.append(1)) > 48 * 2 * 6
    assert len(calls) == HEARD + SEEN


def test_forced_text_has_exactly_so_many_plain_tokens(engine: QwenEngine) -> None:
    opened = engine.open("a", WITH_DEMO)
    answer = engine.fire("a", observation(0), force_text_tokens=45)
    (text,) = answer.texts
    assert answer.is_transition
    assert len(text.token_ids) == 45
    assert not text.truncated
    assert not VOCABULARY.control_ids.intersection(text.token_ids)
    assert max(text.token_ids) < VOCABULARY.num_tokens
    assert answer.context_tokens == opened + 12 + 1 + 45 + 2


def test_forced_text_that_does_not_fit_is_refused(engine: QwenEngine) -> None:
    engine.open("a", WITH_DEMO)
    before = state_of(context_of(engine, "a"))
    with pytest.raises(ContextFull):
        engine.fire("a", observation(0), force_text_tokens=400)
    assert_untouched(context_of(engine, "a"), before)


def test_a_full_context_refuses_before_it_computes(ponder: Ponder) -> None:
    opened = QwenEngine(ponder, CONFIG).open("a", WITH_DEMO)
    engine = QwenEngine(ponder, replace(CONFIG, max_context_tokens=opened + 2 * 14 - 1))
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    before = state_of(context_of(engine, "a"))
    calls: list[int] = []
    with pytest.raises(ContextFull, match=f"holds {opened + 14} tokens and needs 14 more"):
        engine.fire("a", observation(2), lambda: calls.append(1))
    assert not calls
    assert_untouched(context_of(engine, "a"), before)


BAD_FRAMES = {
    "float": (frame(0).astype(np.float32), frame(1)),
    "not finite": (np.full((64, 64, 3), np.nan), frame(1)),
    "too small": (frame(0)[:32], frame(1)),
    "channels first": (frame(0).transpose(2, 0, 1), frame(1)),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_wrong_frame_is_refused_with_its_shape(engine: QwenEngine, name: str) -> None:
    engine.open("a", WITHOUT_DEMO)
    with pytest.raises(ValueError, match=r"observation, frame 0: .* expected uint8 \(64, 64, 3\)"):
        engine.fire("a", BAD_FRAMES[name])  # type: ignore[arg-type]


def test_a_wrong_demo_frame_is_refused_and_nothing_is_opened(engine: QwenEngine) -> None:
    demo = ((frame(0),), (frame(1)[:32],))
    with pytest.raises(ValueError, match="demo instant 1, frame 0"):
        engine.open("a", Opening(instruction="x", demo_frames=demo))
    with pytest.raises(ValueError, match="demo instant 0 has no view"):
        engine.open("a", Opening(instruction="x", demo_frames=((),)))
    with pytest.raises(SessionError, match="not open"):
        engine.close("a")


def test_an_episode_without_an_instruction_is_refused(engine: QwenEngine) -> None:
    with pytest.raises(ValueError, match="'a': the instruction is empty"):
        engine.open("a", Opening(instruction=" "))


def test_a_missing_camera_is_refused(engine: QwenEngine) -> None:
    engine.open("a", WITHOUT_DEMO)
    with pytest.raises(ValueError, match="1 frames, this engine has num_cameras 2"):
        engine.fire("a", (frame(0),))


def test_a_limit_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="max_text_tokens is 0"):
        replace(CONFIG, max_text_tokens=0)
    with pytest.raises(ValueError, match=r"buckets are \(16, 1\)"):
        replace(CONFIG, buckets=(16, 1))


def test_sessions_have_names_and_a_number(engine: QwenEngine) -> None:
    with pytest.raises(SessionError, match="'a' is not open; open are \\[\\]"):
        engine.fire("a", observation(0))
    for name in "abc":
        engine.open(name, WITHOUT_DEMO)
    with pytest.raises(SessionError, match="already open"):
        engine.open("a", WITHOUT_DEMO)
    with pytest.raises(SessionError, match="max_sessions is 3"):
        engine.open("d", WITHOUT_DEMO)
    engine.close("a")
    engine.open("d", WITHOUT_DEMO)


def test_the_memory_of_a_closed_session_serves_the_next_one(engine: QwenEngine) -> None:
    engine.open("a", WITHOUT_DEMO)
    slot = context_of(engine, "a").slot
    engine.close("a")
    engine.open("b", WITHOUT_DEMO)
    assert context_of(engine, "b").slot == slot


def test_the_papers_fire_is_two_images_of_256_px_and_one_carrier() -> None:
    engine = QwenEngine(Ponder.random(tiny_cpu(), seed=0), CONFIG)
    opened = engine.open("a", WITHOUT_DEMO)
    frames = (np.zeros((256, 256, 3), np.uint8), np.full((256, 256, 3), 255, np.uint8))
    answer = engine.fire("a", frames)
    assert answer.context_tokens == opened + 2 * (64 + 2) + 1
    assert answer.cognition.shape == (1, 96)


def test_an_opening_that_does_not_fit_is_refused(engine: QwenEngine) -> None:
    with pytest.raises(ContextFull, match="holds 0 tokens"):
        engine.open("a", Opening(instruction="go " * 400))
    engine.open("a", WITHOUT_DEMO)


def test_a_broken_network_does_not_answer() -> None:
    ponder = untrained()
    with torch.no_grad():
        ponder.qwen.model.language_model.norm.weight.fill_(float("nan"))
    engine = QwenEngine(ponder, CONFIG)
    engine.open("a", WITHOUT_DEMO)
    before = state_of(context_of(engine, "a"))
    with pytest.raises(FloatingPointError, match="cognition is not finite"):
        engine.fire("a", observation(0))
    assert_untouched(context_of(engine, "a"), before)


def test_warm_up_measures_enough_and_leaves_nothing_open(engine: QwenEngine) -> None:
    engine.open("a", WITH_DEMO)
    before = state_of(context_of(engine, "a"))
    durations_ns = engine.warm_up()
    assert len(durations_ns) >= 20
    assert all(duration_ns > 0 for duration_ns in durations_ns)
    assert_untouched(context_of(engine, "a"), before)
    with pytest.raises(SessionError, match=r"open are \['a'\]"):
        engine.close("warm-up")


def test_a_query_in_a_full_context_is_measured_there(engine: QwenEngine) -> None:
    engine.open("a", WITH_DEMO)
    before = state_of(context_of(engine, "a"))
    seen: list[int] = []
    append = Runner.append

    def spy(self: Runner, appends: Sequence[Append]) -> list[torch.Tensor]:
        seen.extend(one.session.num_tokens + len(one.ids) for one in appends)
        return append(self, appends)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "append", spy)
        durations_ns = engine.warm_up_full()
    opening, *queries = seen
    assert opening < engine.spec.max_context_tokens
    assert set(queries) == {engine.spec.max_context_tokens}
    assert 10 <= len(durations_ns) <= len(queries)
    assert all(duration_ns > 0 for duration_ns in durations_ns)
    assert_untouched(context_of(engine, "a"), before)
    with pytest.raises(SessionError, match=r"open are \['a'\]"):
        engine.close("warm-up")


def test_the_spec_says_what_the_engine_is() -> None:
    ponder = Ponder.random(MODEL, VOCABULARY, seed=1, dtype=torch.bfloat16)
    engine = QwenEngine(ponder, CONFIG)
    spec = engine.spec
    assert (spec.num_carriers, spec.hidden_size, spec.image_px, spec.num_cameras) == (2, 96, (64, 64), 2)
    assert (spec.max_context_tokens, spec.is_random, spec.dtype) == (400, True, "bfloat16")
    assert len(spec.model_hash) == 12
    engine.open("a", WITH_DEMO)
    cognition = engine.fire("a", observation(0)).cognition
    assert (cognition.shape, cognition.dtype) == ((2, 96), np.float32)
