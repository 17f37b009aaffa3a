"""Multi-token prediction as a draft: it guesses what its own layer says, and what is written stays greedy text."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from dual_system.models.graphs import directly
from dual_system.models.ponder.checkpoint import load_ponder, mtp_shapes, save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.mtp import MtpHead
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_tokens import allowed_tokens
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server import mtp
from ponder_server.__main__ import build_engine
from ponder_server.config import ContextOptions, PonderOptions, SpeedOptions
from ponder_server.contract import Fire, Opening, Outcome
from ponder_server.draft import Draft, FirstOf, NoDraft, TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.mtp import MAX_DRAFT_TOKENS, WINDOW, MtpDraft
from ponder_server.writer import TransitionWriter

VOCABULARY = Vocabulary.tiny()
MODEL = replace(tiny_cpu(), num_layers=4, hidden_size=48, ffn_size=96, image_px=(64, 64))
CONFIG = EngineConfig(num_cameras=1, max_context_tokens=120, max_sessions=24, max_batch_rows=24, buckets=(1, 16, 64))
NUM_TEXT_TOKENS = 12
ENDS = {VOCABULARY.t_yes, VOCABULARY.t_no, VOCABULARY.end_of_text, VOCABULARY.im_end}
UNSAYABLE = {*VOCABULARY.control_ids, *range(VOCABULARY.num_tokens, MODEL.vocab_size)}
MIXERS = ("o_proj.weight", "out_proj.weight", "down_proj.weight")
FRAMES = (np.zeros((64, 64, 3), np.uint8),)


def random_block(ponder: Ponder, seed: int) -> dict[str, Tensor]:
    """Multi-token prediction that was never trained."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {name: tuple(tensor.shape) for name, tensor in ponder.qwen.state_dict().items()}
    return {
        name: torch.randn(shape, generator=generator) * (0.1 if len(shape) == 1 else shape[-1] ** -0.5)
        for name, shape in mtp_shapes(ponder.qwen.config.text_config, shapes).items()
    }


def untrained(seed: int = 2) -> Ponder:
    ponder = Ponder.random(MODEL, VOCABULARY, seed=seed)
    ponder.mtp = random_block(ponder, seed)
    return ponder


def foreseen(strength: float) -> Ponder:
    """A network whose layers add so much to the last token, and a head that thinks they add nothing.

    With 0 the head knows every text; with a little it is mostly right.
    """
    ponder = untrained()
    with torch.no_grad():
        for name, parameter in ponder.qwen.model.language_model.named_parameters():
            if name.endswith(MIXERS):
                parameter *= strength
    size = ponder.hidden_size
    for name, tensor in ponder.mtp.items():
        if name.endswith(MIXERS):
            tensor.zero_()
    ponder.mtp["mtp.fc.weight"] = torch.eye(size, 2 * size)
    ponder.mtp["mtp.pre_fc_norm_embedding.weight"] = torch.zeros(size)
    ponder.mtp["mtp.norm.weight"] = ponder.qwen.model.language_model.norm.weight.detach().clone()
    return ponder


def written_by(
    engine: QwenEngine, names: Sequence[str], exactly: int | None = NUM_TEXT_TOKENS
) -> tuple[list[Fire], int]:
    """What is answered to a transition in sessions of these names, all together, and in how many forwards."""
    for name in names:
        rng = np.random.default_rng(int(name))
        instruction = "go " + VOCABULARY.decode(rng.integers(60, 380, rng.integers(1, 20)).tolist())
        engine.open(name, Opening(instruction=instruction))
        engine.begin(name, FRAMES, force_text_tokens=exactly)
    found: dict[str, Fire] = {}
    num_forwards = 0
    while len(found) < len(names):
        num_forwards += 1
        outcomes: list[Outcome[Fire]] = engine.step()
        found |= {outcome.session: outcome.unwrap() for outcome in outcomes}
    for name in names:
        engine.close(name)
    return [found[name] for name in names], num_forwards


def tokens(fires: Sequence[Fire]) -> list[tuple[int, ...]]:
    return [text.token_ids for fire in fires for text in fire.texts]


# -- what it proposes

PONDER = untrained()


def rms(x_TH: Tensor, weight_H: Tensor) -> Tensor:
    return x_TH * (x_TH.square().mean(-1, keepdim=True) + 1e-6).rsqrt() * (1 + weight_H)


def said_without_a_cache(ponder: Ponder, written: list[int], hidden_TH: Tensor, most: int) -> tuple[int, ...]:
    """By the tensors alone and transformers' own layer, over everything again for every token."""
    layer: Any = MtpHead(ponder).layers[0]
    inputs, ids, before = [], written, hidden_TH
    guesses: list[int] = []
    while len(guesses) < most:
        both = [
            rms(ponder.embed(ids), ponder.mtp["mtp.pre_fc_norm_embedding.weight"]),
            rms(before, ponder.mtp["mtp.pre_fc_norm_hidden.weight"]),
        ]
        inputs.append(F.linear(torch.cat(both, dim=-1), ponder.mtp["mtp.fc.weight"]))
        x_1TH = torch.cat(inputs)[None]
        positions = 7 + torch.arange(x_1TH.shape[1]).expand(3, 1, -1)  # where a text begins is of no consequence
        turns = ponder.qwen.model.language_model.rotary_emb(x_1TH, positions)
        before = rms(layer(x_1TH, position_embeddings=turns)[0, -1:], ponder.mtp["mtp.norm.weight"])
        order = ponder.logits(before)[0].argsort(descending=True).tolist()
        token = next(t for t in order if t in ENDS or t not in UNSAYABLE)
        if token in ENDS:
            break
        guesses.append(token)
        ids = [token]
    return tuple(guesses)


@given(seed=st.integers(0, 2**31), length=st.integers(1, WINDOW), most=st.integers(1, MAX_DRAFT_TOKENS))
@example(seed=0, length=WINDOW + 9, most=4)
@settings(deadline=None, max_examples=25)
@torch.inference_mode()
def test_it_proposes_what_a_cacheless_forward_of_its_layer_says(seed: int, length: int, most: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    PONDER.mtp = random_block(PONDER, seed)
    draft, captured = (MtpDraft(PONDER, num_tokens=MAX_DRAFT_TOKENS) for _ in range(2))
    captured.capture(directly)
    written = torch.randint(0, 380, (length,), generator=generator).tolist()
    hidden_TH = torch.randn(length, PONDER.hidden_size, generator=generator)
    proposed = draft.propose(written, most, hidden_TH)
    assert proposed == said_without_a_cache(PONDER, written[-WINDOW:], hidden_TH[-WINDOW:], most)
    for one in (draft, captured):
        one.propose(written[::-1], most, -hidden_TH)
        assert one.propose(written, most, hidden_TH) == proposed, "what was asked in between left something behind"


def test_untrained_heads_guess_something() -> None:
    """Or the law above would hold of heads that say nothing."""
    with torch.inference_mode():
        lengths = [
            len(MtpDraft(untrained(seed), num_tokens=4).propose([70], 4, torch.ones(1, 48))) for seed in range(9)
        ]
    assert len(set(lengths)) > 1
    assert max(lengths) == 4


# -- what is written


@pytest.mark.parametrize(
    ("strength", "num_tokens"),
    [
        pytest.param(1.0, 3, marks=pytest.mark.acceptance),
        pytest.param(0.3, 5, marks=pytest.mark.acceptance),
        (0.3, MAX_DRAFT_TOKENS),
    ],
)
def test_texts_are_greedy_texts_whatever_the_weights(strength: float, num_tokens: int) -> None:
    """Random heads accept almost nothing, doctored ones a part, and all of it in rows that share forwards."""
    ponder = untrained() if strength == 1.0 else foreseen(strength)
    names = [str(number) for number in range(CONFIG.max_sessions)]
    greedy, _ = written_by(QwenEngine(ponder, CONFIG, NoDraft()), names)
    guessed, _ = written_by(QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=num_tokens)), names)
    assert len(set(tokens(greedy))) >= len(names) / 2, "texts that do not depend on the prompt would prove little"
    assert tokens(guessed) == tokens(greedy)
    for one, other in zip(guessed, greedy, strict=True):
        np.testing.assert_allclose(one.cognition, other.cognition, rtol=0, atol=1e-4)


def test_texts_are_greedy_texts_though_rare_tokens_are_never_guessed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mtp, "NUM_ROWS", 200)
    ponder = foreseen(0.0)
    draft = MtpDraft(ponder, num_tokens=3)
    names = [str(number) for number in range(8)]
    greedy, _ = written_by(QwenEngine(ponder, CONFIG, NoDraft()), names)
    guessed, _ = written_by(QwenEngine(ponder, CONFIG, draft), names)
    assert tokens(guessed) == tokens(greedy)
    assert any(token >= 200 for text in tokens(greedy) for token in text), "no text has a rare token"
    with torch.inference_mode():
        drafts = [MtpDraft(untrained(seed), num_tokens=4) for seed in range(9)]
        guesses = {token for draft in drafts for token in draft.propose([70], 4, torch.ones(1, 48))}
    assert len(guesses) > 3
    assert max(guesses) < 200


def test_the_writer_hands_over_the_state_before_every_token() -> None:
    """Also of tokens that were right in a forward that was undone: greedy decoding of each state is the token."""
    ponder = foreseen(0.3)
    draft = MtpDraft(ponder, num_tokens=3)
    is_text_V = allowed_tokens(ponder, ends=False)
    asked: list[int] = []

    class Watched(Draft):
        parts = ()

        def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
            assert hidden_TH is not None
            assert ponder.logits(hidden_TH).masked_fill(~is_text_V, -torch.inf).argmax(-1).tolist() == list(written)
            asked.append(len(written))
            return draft.propose(written, max_tokens, hidden_TH)

    written_by(QwenEngine(ponder, CONFIG, Watched()), ["7"])
    accepted = {after - before - 1 for before, after in pairwise(asked)}
    assert accepted & {0, 1, 2}, "nothing was undone"
    assert accepted - {0}, "nothing was right"


def test_no_bit_depends_on_who_else_is_written_for() -> None:
    ponder = foreseen(0.3)
    engine = QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=3))
    together, _ = written_by(engine, ["1", "2", "3"])
    for name, one in zip(["1", "2", "3"], together, strict=True):
        (alone,), _ = written_by(engine, [name])
        assert alone.texts == one.texts
        np.testing.assert_array_equal(alone.cognition, one.cognition)


@pytest.mark.parametrize("num_tokens", [1, 3, MAX_DRAFT_TOKENS])
def test_a_head_that_knows_the_text_takes_one_forward_for_all_it_guesses(num_tokens: int) -> None:
    ponder = foreseen(0.0)
    greedy, num_plain = written_by(QwenEngine(ponder, CONFIG, NoDraft()), ["7"])
    guessed, num_forwards = written_by(QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=num_tokens)), ["7"])
    assert tokens(guessed) == tokens(greedy)
    assert num_plain == 1 + NUM_TEXT_TOKENS + 1  # the observation, every token, the carriers
    assert num_forwards == 1 + math.ceil(NUM_TEXT_TOKENS / (1 + num_tokens)) + 1


def test_a_head_that_is_partly_right_saves_a_part() -> None:
    ponder = foreseen(0.1)
    _, num_forwards = written_by(QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=3)), ["7"])
    _, num_known = written_by(QwenEngine(foreseen(0.0), CONFIG, MtpDraft(foreseen(0.0), num_tokens=3)), ["7"])
    assert num_known < num_forwards < 1 + NUM_TEXT_TOKENS + 1


def test_the_end_is_foreseen_and_not_guessed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guess behind the end of a text would have to be undone, which costs a forward."""
    ponder = foreseen(0.0)
    (plain,), _ = written_by(QwenEngine(ponder, CONFIG, NoDraft()), ["7"], exactly=5)
    last = plain.texts[0].token_ids[-1]
    with torch.no_grad():  # after that token, T_no is by far the most likely
        towards_H = rms(ponder.embed([last]), ponder.qwen.model.language_model.norm.weight)[0]
        ponder.qwen.lm_head.weight[VOCABULARY.t_no] = towards_H / towards_H.norm()
    monkeypatch.setattr(TransitionWriter, "gate", lambda *_: (True, 1.0))
    (greedy,), _ = written_by(QwenEngine(ponder, CONFIG, NoDraft()), ["7"], exactly=None)
    (guessed,), num_forwards = written_by(
        QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=9)), ["7"], exactly=None
    )
    assert guessed.texts == greedy.texts
    assert greedy.texts[0].token_ids[-1] == last
    assert not greedy.texts[0].truncated
    assert num_forwards == 4  # the gate, the observation, the whole text, the carriers


def test_it_is_heard_guess_by_guess() -> None:
    """A head over a large vocabulary takes its time, and who is silent is taken for lost."""
    ponder = foreseen(0.0)
    engine = QwenEngine(ponder, CONFIG, MtpDraft(ponder, num_tokens=3))
    engine.open("a", Opening(instruction="press"))
    heard: list[None] = []
    engine.fire("a", FRAMES, lambda: heard.append(None), force_text_tokens=NUM_TEXT_TOKENS)
    num_forwards = 1 + NUM_TEXT_TOKENS // 4 + 1
    assert len(heard) == MODEL.vision_depth + num_forwards * (MODEL.num_layers + 1) + NUM_TEXT_TOKENS // 4 * 3


# -- beside the trie, and from a checkpoint


def test_examples_go_first_and_the_head_where_they_say_nothing() -> None:
    class Known:
        parts = ()

        def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
            return (99,)[:max_tokens]

    draft: Draft = FirstOf([TrieDraft([(1, 2, 3)]), Known()])
    assert draft.propose((1,), 9) == (2, 3)
    assert draft.propose((7, 8), 9) == (99,)
    assert FirstOf([]).propose((1,), 9) == ()


def test_a_checkpoint_with_a_head_uses_it_if_told_to(tmp_path: Path) -> None:
    ponder = foreseen(0.0)
    save_ponder(ponder, tmp_path / "with")
    options = PonderOptions(checkpoint=tmp_path / "with", context=ContextOptions(max_context_tokens=400))
    num_heard = {}
    for num_tokens in (0, 3):
        engine = build_engine(replace(options, speed=SpeedOptions(draft_tokens=num_tokens)))
        assert isinstance(engine, QwenEngine)
        engine.open("a", Opening(instruction="press"))
        heard: list[None] = []
        engine.fire("a", FRAMES * 2, lambda beats=heard: beats.append(None), force_text_tokens=NUM_TEXT_TOKENS)
        num_heard[num_tokens] = len(heard)
    assert num_heard[3] <= num_heard[0] / 2


def test_a_checkpoint_without_a_head_serves_as_before(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_ponder(Ponder.random(MODEL, VOCABULARY, seed=2), tmp_path / "without")
    with caplog.at_level(logging.WARNING):
        engine = build_engine(
            PonderOptions(
                checkpoint=tmp_path / "without",
                speed=SpeedOptions(draft_tokens=3),
                context=ContextOptions(max_context_tokens=400),
            )
        )
    assert "have no multi-token prediction" in caplog.text
    engine.open("a", Opening(instruction="press"))
    assert engine.fire("a", FRAMES * 2).cognition.shape == (1, 48)


def test_what_cannot_be_run_is_refused(tmp_path: Path) -> None:
    ponder = untrained()
    for num_tokens in (0, MAX_DRAFT_TOKENS + 1):
        with pytest.raises(ValueError, match=f"{num_tokens} tokens at a time were asked for; 1 to 15"):
            MtpDraft(ponder, num_tokens=num_tokens)
    ponder.qwen.config.text_config.mtp_num_hidden_layers = 2
    ponder.mtp = random_block(ponder, 1)
    save_ponder(ponder, tmp_path / "two")
    with pytest.raises(ValueError, match="2 layers of multi-token prediction; 1 can be run"):
        MtpDraft(load_ponder(tmp_path / "two"), num_tokens=3)
