"""Guesses follow the examples, end where examples disagree, and find back after a word of the moment."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from ponder_server.draft import NoDraft, TrieDraft

texts = st.lists(st.integers(0, 5), max_size=12).map(tuple)


@given(st.lists(texts, max_size=5), texts, st.integers(0, 9))
def test_a_guess_is_bounded_and_the_same_every_time(
    examples: list[tuple[int, ...]], written: Sequence[int], max_tokens: int
) -> None:
    guess = TrieDraft(examples).propose(written, max_tokens)
    assert len(guess) <= max_tokens
    assert guess == TrieDraft(examples).propose(list(written), max_tokens)
    assert set(guess) <= {token for example in examples for token in example}


@given(texts, st.integers(0, 12))
def test_one_example_of_different_tokens_is_guessed_to_its_end(example: tuple[int, ...], cut: int) -> None:
    distinct = tuple(dict.fromkeys(example))
    if cut != 1:  # one token alone is no ground for a guess, unless the beginning says more
        assert TrieDraft([distinct]).propose(distinct[:cut], 99) == distinct[cut:]


def test_a_guess_ends_where_the_examples_disagree() -> None:
    draft = TrieDraft([(1, 2, 3, 7, 8), (1, 2, 4, 7, 8), (1, 2, 5, 7, 8)])
    assert draft.propose((), 9) == (1, 2)


def test_a_text_is_recognised_again_behind_a_word_of_the_moment() -> None:
    draft = TrieDraft([(1, 2, 3, 7, 8, 9), (1, 2, 4, 7, 8, 9)])
    assert draft.propose((1, 2, 5), 9) == ()
    assert draft.propose((1, 2, 5, 7, 8), 9) == (9,)


def test_the_more_frequent_word_is_guessed_first() -> None:
    assert TrieDraft([(1, 2), (1, 2), (1, 3)]).propose((), 9) == (1, 2)


def test_no_draft_guesses_nothing() -> None:
    assert NoDraft().propose((1, 2), 9) == ()
