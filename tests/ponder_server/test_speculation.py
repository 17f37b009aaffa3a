"""Drafts change how many forwards a text takes, and nothing else: the tokens are greedy decoding's."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import Fire, Opening
from ponder_server.draft import NoDraft, TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

VOCABULARY = Vocabulary.tiny()
NUM_TEXT_TOKENS = 12
NUM_TOGETHER = 50
PONDER = Ponder.random(
    replace(tiny_cpu(), num_layers=4, hidden_size=48, ffn_size=96, image_px=(32, 32)), VOCABULARY, seed=2
)
CONFIG = EngineConfig(
    num_cameras=1, max_context_tokens=120, max_sessions=NUM_TOGETHER, max_batch_rows=NUM_TOGETHER,
    buckets=(1, 16, 64),
)  # fmt: skip


def prompt(number: int) -> str:
    rng = np.random.default_rng(number)
    return "go " + VOCABULARY.decode(rng.integers(60, 380, rng.integers(1, 20)).tolist())


def texts_of(engine: QwenEngine, numbers: Iterable[int]) -> tuple[list[tuple[int, ...]], int]:
    """What is written after each prompt, all of them together, and in how many forwards."""
    names = [str(number) for number in numbers]
    for name in names:
        engine.open(name, Opening(instruction=prompt(int(name))))
        frame = np.random.default_rng(int(name)).integers(0, 256, (32, 32, 3), dtype=np.uint8)
        engine.begin(name, (frame,), force_text_tokens=NUM_TEXT_TOKENS)
    found: dict[str, Fire] = {}
    num_forwards = 0
    while len(found) < len(names):
        num_forwards += 1
        found |= {outcome.session: outcome.unwrap() for outcome in engine.step()}
    for name in names:
        engine.close(name)
    return [found[name].texts[0].token_ids for name in names], num_forwards


def half_right(texts: Iterable[tuple[int, ...]]) -> TrieDraft:
    """Examples of what will be said, but for every fifth token."""
    return TrieDraft([tuple(t if i % 5 else t // 2 for i, t in enumerate(text)) for text in texts])


@pytest.mark.parametrize("num_prompts", [NUM_TOGETHER, pytest.param(2 * NUM_TOGETHER, marks=pytest.mark.acceptance)])
def test_speculative_texts_are_greedy_texts(num_prompts: int) -> None:
    plain = QwenEngine(PONDER, CONFIG, NoDraft())
    num_plain = num_speculative = 0
    for start in range(0, num_prompts, NUM_TOGETHER):
        numbers = range(start, start + NUM_TOGETHER)
        greedy, num_forwards = texts_of(plain, numbers)
        num_plain += num_forwards
        assert len(set(greedy)) > NUM_TOGETHER / 2, "texts that do not depend on the prompt would prove little"
        speculative, num_forwards = texts_of(QwenEngine(PONDER, CONFIG, half_right(greedy)), numbers)
        num_speculative += num_forwards
        assert speculative == greedy
    assert num_speculative != num_plain, "nothing was guessed"


def test_a_draft_that_is_right_saves_forwards() -> None:
    greedy, num_forwards = texts_of(QwenEngine(PONDER, CONFIG, NoDraft()), [7])
    speculative, num_fewer = texts_of(QwenEngine(PONDER, CONFIG, TrieDraft(greedy)), [7])
    assert speculative == greedy
    assert num_forwards == 1 + NUM_TEXT_TOKENS + 1  # the observation, every token, the carriers
    assert num_fewer < num_forwards / 3


def test_a_draft_that_is_wrong_is_forgotten() -> None:
    """Nothing of a wrong guess stays: the cognition behind the text is that of plain decoding."""
    answers = []
    for draft in (NoDraft(), TrieDraft([range(100, 112)])):
        engine = QwenEngine(PONDER, CONFIG, draft)
        engine.open("a", Opening(instruction="press the button"))
        answers.append(engine.fire("a", (np.zeros((32, 32, 3), np.uint8),), force_text_tokens=NUM_TEXT_TOKENS))
    plain, speculative = answers
    assert speculative.texts == plain.texts
    np.testing.assert_allclose(speculative.cognition, plain.cognition, rtol=0, atol=1e-4)
