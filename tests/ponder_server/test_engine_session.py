"""Numerical twins of a session: however it was appended, it holds what one cacheless encode would."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ponder_server.contract import ContextFull
from ponder_server.session import Session
from ponderpounce.models.context import Row, Transition
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_configs import tiny_cpu
from ponderpounce.models.vocabulary import Vocabulary

TOLERANCE = 1e-4  # float32, hidden states of size 4

VOCABULARY = Vocabulary.tiny()
PONDER = Ponder.random(replace(tiny_cpu(), image_px=(64, 64), num_carriers=2), VOCABULARY, seed=1)
FORMAT = PONDER.format
ROW: Row = FORMAT.row(
    [
        *FORMAT.opening("pick up the red cube and place it on the target at <72, 104>", [2, 1, 1]),
        *FORMAT.query(2, Transition(subgoal=VOCABULARY.encode("move to"), reasoning=VOCABULARY.encode("go"))),
        *(segment for _ in range(4) for segment in FORMAT.query(2)),
        *FORMAT.query(2, Transition(subgoal=VOCABULARY.encode("then press the button"))),
    ]
)
generator = torch.Generator().manual_seed(5)
FRAMES = torch.randint(0, 256, (ROW.num_images, 64, 64, 3), generator=generator, dtype=torch.uint8)
with torch.inference_mode():
    EMBEDS = PONDER.embed(ROW.ids, FRAMES)
    FULL = PONDER.encode_row(ROW, FRAMES)
T = len(ROW.ids)
CUTS = [i for i in range(1, T) if VOCABULARY.image_pad not in (ROW.ids[i], ROW.ids[i - 1])]


def new_session(max_tokens: int = 512) -> Session:
    return Session(PONDER, max_tokens=max_tokens)


def feed(session: Session, first: int, end: int) -> torch.Tensor:
    with torch.inference_mode():
        return session.append(ROW.ids[first:end], EMBEDS[first:end])


def text_error(chunk: int, num_tokens: int = 140) -> float:
    ids = np.random.default_rng(2).integers(0, 384, num_tokens).tolist()
    with torch.inference_mode():
        embeds = PONDER.embed(ids)
        positions, _ = FORMAT.positions(ids)
        full = PONDER(embeds[None], torch.from_numpy(positions)[:, None])[0]
        session = new_session()
        pieces = [session.append(ids[i : i + chunk], embeds[i : i + chunk]) for i in range(0, len(ids), chunk)]
    return float((torch.cat(pieces) - full).abs().max())


@settings(deadline=None, max_examples=12)
@given(st.sets(st.sampled_from(CUTS), max_size=8))
def test_any_way_of_appending_equals_one_full_encode(cuts: set[int]) -> None:
    session = new_session()
    pieces = [feed(session, first, end) for first, end in pairwise([0, *sorted(cuts), T])]
    assert (torch.cat(pieces) - FULL).abs().max() < TOLERANCE
    assert session.ids == list(ROW.ids)


@pytest.mark.parametrize("chunk", [1, 3, 4, 5, 63, 64, 65, 128])
def test_chunks_around_the_conv_width_and_the_kernel_chunk_are_exact(chunk: int) -> None:
    assert text_error(chunk) < TOLERANCE


def test_a_restored_session_has_forgotten_the_wrong_branch_to_the_last_bit() -> None:
    once, twice = new_session(), new_session()
    middle = CUTS[len(CUTS) // 2]
    feed(once, 0, middle)
    feed(twice, 0, middle)
    saved = twice.save()
    with torch.inference_mode():
        wrong = [5] * 200
        twice.append(wrong, 3.0 * PONDER.embed(wrong))
        twice.restore(saved)
    assert torch.equal(feed(twice, middle, T), feed(once, middle, T))
    assert twice.ids == once.ids


def test_a_state_can_be_restored_twice() -> None:
    session = new_session()
    middle = CUTS[len(CUTS) // 2]
    feed(session, 0, middle)
    saved = session.save()
    first = feed(session, middle, T)
    session.restore(saved)
    second = feed(session, middle, T)
    assert torch.equal(first, second)


def test_a_fork_continues_alike_and_independently() -> None:
    trunk, fork = new_session(), new_session()
    middle = CUTS[len(CUTS) // 2]
    feed(trunk, 0, middle)
    trunk.fork_into(fork)
    with torch.inference_mode():
        trunk.append([5, 6, 7], PONDER.embed([5, 6, 7]))
    continued = feed(fork, middle, T)
    straight = new_session()
    feed(straight, 0, middle)
    assert torch.equal(continued, feed(straight, middle, T))
    assert trunk.num_tokens == middle + 3


def test_a_fork_that_does_not_fit_is_refused() -> None:
    trunk = new_session()
    feed(trunk, 0, T)
    with pytest.raises(ContextFull):
        trunk.fork_into(new_session(max_tokens=T - 1))


def test_sessions_do_not_disturb_each_other() -> None:
    left, right = new_session(), new_session()
    bounds = [0, *CUTS[10::25], T]
    interleaved = [(feed(left, a, b), feed(right, a, b)) for a, b in pairwise(bounds)]
    for pieces in zip(*interleaved, strict=True):
        assert (torch.cat(pieces) - FULL).abs().max() < TOLERANCE
    assert PONDER.qwen.model.rope_deltas is None


def test_a_cleared_session_is_a_new_one_to_the_last_bit() -> None:
    used = new_session()
    feed(used, 0, T)
    used.clear()
    assert torch.equal(feed(used, 0, T), feed(new_session(), 0, T))


def test_an_append_keeps_every_address() -> None:
    session = new_session()
    tensors = session._cache.recurrent_tensors()
    feed(session, 0, T)
    session.restore(session.save())
    session.clear()
    assert [t.data_ptr() for t in session._cache.recurrent_tensors()] == [t.data_ptr() for t in tensors]


def test_an_overflow_is_refused_before_anything_happens() -> None:
    session = new_session(max_tokens=T - 1)
    middle = CUTS[-4]
    feed(session, 0, middle)
    with pytest.raises(ContextFull, match=f"holds {middle} tokens and needs {T - middle} more, .* {T - 1}"):
        feed(session, middle, T)
    assert torch.equal(feed(session, middle, T - 1), _tail(middle, T - 1))


def _tail(middle: int, end: int) -> torch.Tensor:
    session = new_session()
    feed(session, 0, middle)
    return feed(session, middle, end)
