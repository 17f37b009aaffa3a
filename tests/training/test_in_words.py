"""What is taken over of another checkpoint is the same numbers, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights, tokenizer_of_instructions, with_subgoal
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_groot
from dual_system.training.in_words import told_in_words

TOLD = with_subgoal("press the button", "pick up the cube at [401, 387]")


def knowing() -> PounceBundle:
    return random_bundle(pounce_configs.tiny_cpu(), seed=1)


def reads_words() -> pounce_configs.PounceConfig:
    return replace(pounce_configs.tiny_cpu(num_carriers=0), reads_subgoal=True)


@pytest.mark.parametrize("has_new_words", [False, True])
def test_who_is_told_in_words_has_the_others_skill(has_new_words: bool) -> None:
    skilled = knowing()
    tokenizer = tokenizer_of_instructions([TOLD]) if has_new_words else None
    reader = told_in_words(skilled, reads_words(), tokenizer, seed=3)
    known = skilled.model.state_dict()
    for name, taken in reader.model.state_dict().items():
        is_taken = "embed_tokens" not in name or not has_new_words
        assert torch.equal(taken, known[name]) == is_taken, name
    assert reader.model.cognition_prefix is None
    assert reader.statistics == skilled.statistics
    assert reader.tokenizer.model_bytes == (tokenizer or skilled.tokenizer).model_bytes


def test_it_survives_its_folder(tmp_path: Path) -> None:
    reader = told_in_words(knowing(), reads_words(), None, seed=3)
    save_bundle(reader, tmp_path)
    assert load_bundle(tmp_path).digest() == reader.digest()


def test_another_size_or_family_is_refused() -> None:
    reads = reads_words()
    larger = replace(reads, pi05=replace(reads.pi05, vocab_size=2 * reads.pi05.vocab_size))
    with pytest.raises(ValueError, match="another size"):
        told_in_words(knowing(), larger, None, seed=0)
    with pytest.raises(ValueError, match="start GR00T from its public folder"):
        told_in_words(random_bundle(tiny_groot(), seed=1), reads_words(), None, seed=0)


def test_all_that_is_told_becomes_few_tokens() -> None:
    """Otherwise every digit of every place costs as much as a word of PaliGemma's."""
    told = [with_subgoal("press the button", f"pick up the cube at [{x}, {7 * x % 1000}]") for x in range(100, 1000, 7)]
    own, public = tokenizer_of_instructions(told), tiny_tokenizer_for_random_weights()
    assert len(own.encode(TOLD)) < 20 < len(public.encode(TOLD))
    assert own.encode(with_subgoal("press the button", "at [123, 456]")) != own.encode(
        with_subgoal("press the button", "at [456, 123]")
    )
