"""A session: append, save, restore, fork, refuse; memory is allocated once and counted beforehand."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.graphs import directly
from dual_system.models.ponder.configs import qwen35_9b, tiny_cpu
from dual_system.models.ponder.context import Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import ContextFull, SessionError
from ponder_server.runner import BUCKETS, Append, Runner, Session, fitted
from ponder_server.slots import slot_size

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
    return Runner(PONDER, num_slots=1, max_tokens=max_tokens).open("a")


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


@settings(deadline=None, max_examples=4)
@given(st.sets(st.sampled_from(CUTS), min_size=3, max_size=3), st.booleans(), st.sampled_from([(1, 16, 512), (7,)]))
def test_an_append_keeps_the_state_of_its_first_tokens_alone(
    cuts: set[int], is_captured: bool, buckets: tuple[int, ...]
) -> None:
    """A neighbour that keeps none shares the forward; what comes after the kept tokens leaves no trace."""
    first, middle, end = sorted(cuts)
    runner = Runner(PONDER, num_slots=3, max_tokens=512, buckets=buckets)
    if is_captured:
        runner.capture(directly, num_read=16)
    keeps, alone, neighbour = (runner.open(name) for name in ("keeps", "alone", "neighbour"))
    for session in (keeps, alone):
        feed(session, 0, first)
    before = neighbour.save(neighbour.kept)
    untouched = [tensor.clone() for tensor in before.tensors]
    with torch.inference_mode():
        whole = Append(session=keeps, ids=ROW.ids[first:end], embeds_TH=EMBEDS[first:end], num_kept=middle - first)
        runner.append([whole, Append(session=neighbour, ids=ROW.ids[:end], embeds_TH=EMBEDS[:end])])
    assert all(map(torch.equal, neighbour.kept.tensors, untouched))
    keeps.restore(keeps.kept)
    feed(alone, first, middle)
    assert (keeps.ids, keeps.next_position) == (alone.ids, alone.next_position)
    for kept, expected in zip(runner.memory.states(keeps.slot), runner.memory.states(alone.slot), strict=True):
        torch.testing.assert_close(kept, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(feed(keeps, middle, T), feed(alone, middle, T), rtol=0, atol=TOLERANCE)


def test_forks_of_one_prefix_continue_alike_and_independently() -> None:
    runner = Runner(PONDER, num_slots=3, max_tokens=512)
    middle = CUTS[len(CUTS) // 2]
    trunk = runner.open("trunk")
    feed(trunk, 0, middle)
    prefix = trunk.copy()
    with torch.inference_mode():
        trunk.append([5, 6, 7], PONDER.embed([5, 6, 7]))
    forks = [runner.open(name).start_from(prefix) for name in ("left", "right")]
    continued = [feed(fork, middle, T) for fork in forks]
    straight = new_session()
    feed(straight, 0, middle)
    expected = feed(straight, middle, T)
    assert all(torch.equal(one, expected) for one in continued)
    assert [fork.ids for fork in forks] == [straight.ids] * 2
    assert trunk.num_tokens == middle + 3


def test_a_prefix_costs_what_its_length_says() -> None:
    size = slot_size(PONDER.qwen.config.text_config, torch.float32)
    session = new_session()
    feed(session, 0, CUTS[20])
    assert session.copy().num_bytes == size.slot_bytes(CUTS[20])


def test_a_fork_that_does_not_fit_is_refused() -> None:
    trunk = new_session()
    feed(trunk, 0, T)
    with pytest.raises(ContextFull):
        new_session(max_tokens=T - 1).start_from(trunk.copy())


def test_sessions_do_not_disturb_each_other() -> None:
    runner = Runner(PONDER, num_slots=2, max_tokens=512)
    left, right = runner.open("left"), runner.open("right")
    bounds = [0, *CUTS[10::25], T]
    interleaved = [(feed(left, a, b), feed(right, a, b)) for a, b in pairwise(bounds)]
    for pieces in zip(*interleaved, strict=True):
        assert (torch.cat(pieces) - FULL).abs().max() < TOLERANCE
    assert PONDER.qwen.model.rope_deltas is None


def test_a_slot_that_was_used_is_a_new_one_to_the_last_bit() -> None:
    runner = Runner(PONDER, num_slots=1, max_tokens=512)
    used = runner.open("used")
    feed(used, 0, T)
    runner.close(used)
    again = runner.open("again")
    assert again.slot == used.slot
    assert torch.equal(feed(again, 0, T), feed(new_session(), 0, T))


def test_a_filled_context_is_as_long_as_it_was_told_and_leaves_no_trace() -> None:
    session = new_session()
    feed(session, 0, CUTS[3])
    saved, before = session.save(), feed(session, CUTS[3], T)
    session.restore(saved)
    session.fill(500)
    assert (session.num_tokens, session.room) == (500, 12)
    with torch.inference_mode():
        assert session.append(ROW.ids[:12], EMBEDS[:12]).isfinite().all()
    session.restore(saved)
    assert torch.equal(feed(session, CUTS[3], T), before)


def test_there_are_as_many_sessions_as_slots() -> None:
    runner = Runner(PONDER, num_slots=2, max_tokens=512)
    sessions = [runner.open(name) for name in "ab"]
    assert sessions[0].slot != sessions[1].slot
    with pytest.raises(SessionError, match="'c' does not fit: all 2 slots are in use"):
        runner.open("c")


def test_an_append_keeps_every_address() -> None:
    runner = Runner(PONDER, num_slots=2, max_tokens=512)
    addresses = [t.data_ptr() for slot in range(2) for t in runner.memory.states(slot)]
    session = runner.open("a")
    feed(session, 0, T)
    session.restore(session.save())
    assert [t.data_ptr() for slot in range(2) for t in runner.memory.states(slot)] == addresses


def test_a_save_is_two_copies_however_many_layers_there_are() -> None:
    memory = Runner(Ponder.random(tiny_cpu(), VOCABULARY, seed=1), num_slots=2, max_tokens=10).memory
    assert len(memory.recurrent) > 2
    assert all(tensor.is_contiguous() for tensor in memory.states(1))
    assert len(memory.states(1)) == 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_memory_is_known_before_it_is_allocated(dtype: torch.dtype) -> None:
    ponder = Ponder.random(tiny_cpu(), VOCABULARY, seed=1, dtype=dtype)
    size = slot_size(ponder.qwen.config.text_config, dtype)
    memory = Runner(ponder, num_slots=1, max_tokens=100).memory
    assert size.slot_bytes(100) == sum(t.nbytes for t in (*memory.states(0), *memory.keys_and_values(0, 100)))


def test_the_papers_session_is_562_mib() -> None:
    size = slot_size(qwen35_9b().qwen().text_config, torch.bfloat16)
    assert size.bytes_per_token == 32 * 1024
    assert round(size.slot_bytes(16_384) / 2**20) == 562


@pytest.mark.parametrize("num_wanted", [0, 1, 3, T])
def test_wanted_are_the_last_hidden_states_also_across_forwards(num_wanted: int) -> None:
    session = Runner(PONDER, num_slots=1, max_tokens=512, buckets=(1, 2, 50)).open("a")
    with torch.inference_mode():
        hidden = session.append(ROW.ids, EMBEDS, num_wanted=num_wanted)
    assert hidden.shape == (num_wanted, PONDER.hidden_size)
    torch.testing.assert_close(hidden, FULL[T - num_wanted :], rtol=0, atol=TOLERANCE)


def test_an_append_that_does_not_fit_leaves_its_neighbours_alone() -> None:
    runner = Runner(PONDER, num_slots=2, max_tokens=20)
    left, right = runner.open("left"), runner.open("right")
    with torch.inference_mode():
        embeds_TH = PONDER.embed([5] * 21)
        with pytest.raises(ContextFull, match="'right' holds 0 tokens"):
            runner.append(
                [
                    Append(session=left, ids=[5] * 4, embeds_TH=embeds_TH[:4]),
                    Append(session=right, ids=[5] * 21, embeds_TH=embeds_TH),
                ]
            )
    assert (left.num_tokens, right.num_tokens) == (0, 0)
    assert not any(state.any() for state in runner.memory.states(left.slot))


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


@given(st.integers(1, 2048))
def test_a_query_is_not_padded_to_twice_its_length_in_steps(num_query_ids: int) -> None:
    buckets = fitted(BUCKETS, num_query_ids)
    assert set(BUCKETS) <= set(buckets)
    assert list(buckets) == sorted(set(buckets))
    padded = next(bucket for bucket in buckets if bucket >= num_query_ids)
    assert padded < 2 * (num_query_ids + 16)
