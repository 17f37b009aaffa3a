"""Laws of the prompt: bins and text as the public code has them, and one tiny tokenizer for all."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.pi05.prompt import (
    TINY_VOCAB_SIZE,
    Tokenizer,
    prompt_text,
    state_bins,
    tiny_tokenizer_for_random_weights,
    tokenizer_of_instructions,
    with_subgoal,
)
from dual_system.models.ponder.coordinates import PLACE_WORDS


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return tiny_tokenizer_for_random_weights()


@settings(deadline=None)
@given(value=st.floats(-1, 1))
def test_a_bin_contains_its_value(value: float) -> None:
    (bin_,) = state_bins([value])
    assert 0 <= bin_ <= 255
    assert -1 + 2 * bin_ / 256 <= value
    assert bin_ == 255 or value < -1 + 2 * (bin_ + 1) / 256


@settings(deadline=None)
@given(low=st.floats(-3, 3), high=st.floats(-3, 3))
def test_bins_keep_order(low: float, high: float) -> None:
    low, high = sorted((low, high))
    first, second = state_bins([low, high])
    assert first <= second


def test_bins_at_the_ends_and_beyond() -> None:
    assert state_bins([-1.01, -1.0, 0.0, 1.0, 9.0]) == [-1, 0, 128, 255, 255]


def test_prompt_is_the_public_template_with_one_number_per_robot_dim() -> None:
    text = prompt_text("  put_the red\ncube down ", np.array([-1.0, 0.0, 1.0]))
    assert text == "Task: put the red cube down, State: 0 128 255;\nAction: "


def test_a_subgoal_follows_the_instruction_and_none_leaves_it_alone() -> None:
    told = with_subgoal("press the button ", " pick the cube at [78, 4]")
    assert prompt_text(told, np.array([0.0])) == (
        "Task: press the button, Subgoal: pick the cube at [78, 4], State: 128;\nAction: "
    )
    assert with_subgoal("press the button ", " ") == "press the button "


@settings(deadline=None)
@given(text=st.text(max_size=40))
def test_every_text_has_tokens_the_model_embeds(tokenizer: Tokenizer, text: str) -> None:
    ids = tokenizer.encode(text)
    assert ids[0] == 2, "PaliGemma's BOS"
    assert all(0 <= id_ < TINY_VOCAB_SIZE for id_ in ids)


def test_tiny_tokenizer_is_the_same_every_time(tokenizer: Tokenizer) -> None:
    assert tiny_tokenizer_for_random_weights().model_bytes == tokenizer.model_bytes


def test_tiny_tokenizer_splits_digits(tokenizer: Tokenizer) -> None:
    assert len(tokenizer.encode("255")) == len(tokenizer.encode("25")) + 1


def test_tokenizer_survives_its_file(tokenizer: Tokenizer, tmp_path: Path) -> None:
    path = tmp_path / "tokenizer.model"
    path.write_bytes(tokenizer.model_bytes)
    prompt = prompt_text("pick up the cube", np.zeros(8))
    assert Tokenizer.from_file(path).encode(prompt) == tokenizer.encode(prompt)


def test_missing_tokenizer_names_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"paligemma_tokenizer\.model.*--tokenizer"):
        Tokenizer.from_file(tmp_path / "absent.model")


def test_a_word_is_one_piece_and_the_text_stays_readable() -> None:
    prompts = ["pick up the red cube at [438, 512]", "press the button"]
    tokenizer = tokenizer_of_instructions(prompts, 1024, words=PLACE_WORDS)
    ids = tokenizer.encode("press the button at [230, 438]")
    pieces = [tokenizer._pieces.id_to_piece(each).replace("\N{LOWER ONE EIGHTH BLOCK}", " ") for each in ids]
    assert pieces[-2:] == [" [230,", " 438]"]
    assert tokenizer._pieces.decode(ids) == "press the button at [230, 438]"
