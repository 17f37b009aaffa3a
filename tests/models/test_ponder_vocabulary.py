"""The tokenizer: any text survives, control tokens keep their names, none can be smuggled in."""

import hashlib
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer, models

from dual_system.models.ponder.coordinates import PLACE_WORDS
from dual_system.models.ponder.vocabulary import CONTROL_TOKENS, Vocabulary

TINY = Vocabulary.tiny()


@given(st.text(st.characters(codec="ascii"), max_size=40).filter(lambda s: "<" not in s))
def test_plain_text_survives(text: str) -> None:
    assert TINY.decode(TINY.encode(text)) == text


def test_two_trainings_give_one_tokenizer() -> None:
    assert Vocabulary.tiny().names() == TINY.names()


def test_control_tokens_keep_qwens_order_behind_the_text_tokens() -> None:
    ids = [TINY.id_of(name) for name in CONTROL_TOKENS]
    assert ids == list(range(ids[0], ids[0] + len(CONTROL_TOKENS)))
    assert TINY.num_tokens == ids[-1] + 1
    assert TINY.control_ids == set(ids)


def test_the_tiny_tokenizer_is_the_one_that_checkpoints_were_trained_with() -> None:
    spelled = json.dumps(sorted(TINY.names().items())).encode()
    assert (TINY.num_tokens, TINY.t_yes) == (417, 400)
    assert hashlib.sha256(spelled).hexdigest()[:16] == "058ded6ad758d45c"


def test_a_tokenizer_trained_on_texts_says_them_in_fewer_tokens() -> None:
    texts = ["sweep the crumbs towards the dustpan at <72, 104>", "sweep the crumbs towards the bin"]
    own = Vocabulary.trained_on(texts, num_tokens=350)
    assert own.num_tokens <= 350
    assert own.names() == Vocabulary.trained_on(iter(texts), num_tokens=350).names()
    for text in texts:
        assert own.decode(own.encode(text)) == text
        assert len(own.encode(text)) < len(TINY.encode(text))
    assert own.decode(own.encode("größer → 2")) == "größer → 2"


def test_a_tokenizer_without_room_for_bytes_and_control_tokens_is_refused() -> None:
    with pytest.raises(ValueError, match="num_tokens is 288; bytes and control tokens alone are 289"):
        Vocabulary.trained_on(["pick"], num_tokens=288)


def test_a_word_is_one_token_wherever_it_stands_and_digits_elsewhere_are_not() -> None:
    texts = ["pick up the red cube at [438, 512]", "press the button at [500, 230], then stop"]
    told = Vocabulary.trained_on(texts, 2048, words=PLACE_WORDS)
    for text in texts:
        ids = told.encode(text)
        assert told.decode(ids) == text
        assert sum(told.decode([each]) in PLACE_WORDS for each in ids) == 2
    assert len(told.encode(" [500, 512]")) == 2
    assert len(told.encode("2026")) == 4


def test_words_without_room_are_refused() -> None:
    with pytest.raises(ValueError, match="num_tokens 600 has no room for 514 words"):
        Vocabulary.trained_on(["pick"], 600, words=PLACE_WORDS)


def test_digits_are_single_tokens() -> None:
    assert len(TINY.encode("2026")) == 4


@pytest.mark.parametrize("name", CONTROL_TOKENS)
def test_no_control_token_can_come_from_text(name: str) -> None:
    with pytest.raises(ValueError, match="control token"):
        TINY.encode(f"take the {name} cube")


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    TINY.save(tmp_path)
    loaded = Vocabulary.load(tmp_path)
    assert loaded.names() == TINY.names()
    text = "move to <77, 103> → the 2nd button"
    assert loaded.encode(text) == TINY.encode(text)
    assert loaded.t_yes == TINY.t_yes


def test_a_tokenizer_without_the_gate_tokens_is_refused() -> None:
    with pytest.raises(ValueError, match="fim_prefix"):
        Vocabulary(Tokenizer(models.BPE()))


def test_a_folder_without_a_tokenizer_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"tokenizer\.json"):
        Vocabulary.load(tmp_path)
