"""An opening is laid into its context once, in a few chunks; an equal one of before is copied instead."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.context import ContextFormat, Segment
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import Frame, Opening, no_progress
from ponder_server.opening import Opener
from ponder_server.prefixes import Prefixes

FORM = ContextFormat(vocabulary=Vocabulary.tiny(), num_carriers=1, first_carrier_id=440, image_grid=(1, 1), token_px=1)
INSTRUCTION = "press"

demonstrations = st.lists(st.lists(st.integers(0, 3), min_size=1, max_size=2).map(tuple), max_size=4).map(tuple)
"""Per instant, the brightness of every view's only pixel."""
Demo = tuple[tuple[int, ...], ...]


def opening_of(demo: Demo, instruction: str = INSTRUCTION) -> Opening:
    frames = tuple(tuple(np.full((1, 1, 3), value, np.uint8) for value in views) for views in demo)
    return Opening(instruction=instruction, demo_frames=frames)


def segments_of(opening: Opening) -> tuple[Segment, ...]:
    return FORM.opening(opening.instruction, [len(views) for views in opening.demo_frames])


@dataclass
class FakeContext:
    """Keeps what was appended, a picture as its brightness; a copy is the same list."""

    tokens: list[Any] = field(default_factory=list)
    appends: list[int] = field(default_factory=list)
    copies: int = 0

    def append(self, ids: list[int], embeds: list[Any], *, num_wanted: int) -> None:
        assert num_wanted == 0
        assert len(ids) == len(embeds)
        self.tokens += embeds
        self.appends.append(len(ids))

    def copy(self) -> list[Any]:
        self.copies += 1
        return list(self.tokens)

    def start_from(self, prefix: list[Any]) -> None:
        assert not self.tokens
        self.tokens += prefix


def embed(ids: list[int], pictures: list[Frame]) -> list[Any]:
    """Every image position shows the next picture; all pictures must be used."""
    shown = iter(pictures)
    found = [int(next(shown)[0, 0, 0]) if token == FORM.vocabulary.image_pad else f"token {token}" for token in ids]
    assert next(shown, None) is None
    return found


def opener(*, max_prefixes: int = 2, chunk_tokens: int = 4096) -> Opener:
    return Opener(embed, max_prefixes=max_prefixes, chunk_tokens=chunk_tokens)  # type: ignore[arg-type]


def encoded(opener: Opener, opening: Opening, progress: Any = no_progress) -> FakeContext:
    context = FakeContext()
    pictures = [picture for views in opening.demo_frames for picture in views]
    for _ in opener.encode(context, opening, segments_of(opening), pictures):  # type: ignore[arg-type]
        progress()
    return context


def expected(opening: Opening) -> list[Any]:
    ids = [token for segment in segments_of(opening) for token in segment.ids]
    return embed(ids, [picture for views in opening.demo_frames for picture in views])


@given(demonstrations, st.integers(1, 30))
def test_every_token_and_picture_comes_once_and_in_order_whatever_the_chunks(demo: Demo, chunk_tokens: int) -> None:
    opening, heard = opening_of(demo), []
    context = encoded(opener(chunk_tokens=chunk_tokens), opening, lambda: heard.append(1))
    assert context.tokens == expected(opening)
    longest = max(len(segment) for segment in segments_of(opening))
    assert all(num_tokens <= max(chunk_tokens, longest) for num_tokens in context.appends)
    assert len(heard) == len(context.appends)


@given(st.lists(st.tuples(demonstrations, st.sampled_from(["press", "pick"])), min_size=1, max_size=6))
def test_whatever_was_opened_before_a_context_holds_its_own_opening(episodes: list[tuple[Demo, str]]) -> None:
    shared = opener()
    for demo, instruction in episodes:
        opening = opening_of(demo, instruction)
        assert encoded(shared, opening).tokens == expected(opening)


def test_an_equal_demonstration_is_copied_and_not_encoded() -> None:
    shared, opening = opener(), opening_of(((1, 2), (3,)))
    first, second = encoded(shared, opening), encoded(shared, opening_of(((1, 2), (3,))))
    assert (first.copies, second.appends) == (1, [])


@pytest.mark.parametrize(
    ("demo", "instruction"), [(((1,), (2, 3)), "press"), (((1, 2), (4,)), "press"), (((1, 2), (3,)), "pick")]
)
def test_another_opening_is_not_taken_for_this_one(demo: Demo, instruction: str) -> None:
    shared = opener()
    encoded(shared, opening_of(((1, 2), (3,))))
    assert encoded(shared, opening_of(demo, instruction)).appends != []


def test_without_a_demonstration_nothing_is_kept() -> None:
    shared, opening = opener(), opening_of(())
    assert [encoded(shared, opening).copies for _ in range(2)] == [0, 0]


@given(st.lists(st.integers(0, 3), max_size=12), st.integers(0, 3))
def test_the_openings_that_were_used_last_are_kept(used: list[int], max_prefixes: int) -> None:
    shared = opener(max_prefixes=max_prefixes)
    kept: list[int] = []
    for value in used:
        was_encoded = encoded(shared, opening_of(((value,),))).appends != []
        assert was_encoded == (value not in kept)
        kept = [*(each for each in kept if each != value), value][-max_prefixes:] if max_prefixes else []


def test_without_memory_for_a_copy_it_does_without() -> None:
    class Full(FakeContext):
        def copy(self) -> list[Any]:
            raise torch.OutOfMemoryError

    prefixes, opening = Prefixes(2), opening_of(((1,),))
    prefixes.keep(opening, FakeContext())  # type: ignore[arg-type]
    assert prefixes.find(opening) is not None
    prefixes.keep(opening_of(((2,),)), Full())  # type: ignore[arg-type]
    assert prefixes.find(opening) is None
