"""Numerical twins: whatever the network's shape and the way of appending, a slot holds what transformers' own cacheless
forward over the whole row computes. Rows of different lengths share forwards; some idle, some go astray and come back.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import PonderConfig, tiny_cpu
from dual_system.models.ponder.context import Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.decoder import Place, decode
from ponder_server.runner import Append, Runner, Session

TOLERANCE = 1e-4  # float32, hidden states of size 4
NUM_ROWS = 3
VOCABULARY = Vocabulary.tiny()


@st.composite
def configs(draw: st.DrawFn) -> PonderConfig:
    key_heads, gdn_key_heads = draw(st.integers(1, 2)), draw(st.integers(1, 2))
    head_dim, mrope_section = draw(st.sampled_from([(32, (2, 1, 1)), (64, (3, 3, 2))]))
    return replace(
        tiny_cpu(),
        hidden_size=draw(st.sampled_from([32, 48])),
        ffn_size=64,
        num_layers=draw(st.sampled_from([3, 4, 5, 8])),  # the last layer is of either kind
        num_query_heads=key_heads * draw(st.integers(1, 3)),
        num_kv_heads=key_heads,
        head_dim=head_dim,
        mrope_section=mrope_section,
        num_gdn_key_heads=gdn_key_heads,
        num_gdn_value_heads=gdn_key_heads * draw(st.integers(1, 2)),
        gdn_head_dim=draw(st.sampled_from([16, 32])),
        num_carriers=draw(st.integers(1, 3)),
        image_px=draw(st.sampled_from([(64, 64), (32, 96)])),
    )


def episode(ponder: Ponder, index: int, num_more: int = 0) -> Row:
    """Rows of different lengths, with images, text and carriers; and with so many queries more."""
    form = ponder.format
    speaks = Transition(subgoal=VOCABULARY.encode("press the button"), reasoning=VOCABULARY.encode("go"))
    opening = form.opening("pick up the cube " * (1 + index), [1] * index)
    more = [segment for _ in range(num_more) for segment in form.query(2)]
    return form.row([*opening, *form.query(2), *form.query(2, speaks), *form.query(1 + index), *more])


@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    row: Row
    embeds_TH: torch.Tensor
    expected_TH: torch.Tensor


def twin(ponder: Ponder, index: int) -> Twin:
    row = episode(ponder, index)
    generator = torch.Generator().manual_seed(index)
    frames = torch.randint(0, 256, (row.num_images, *ponder.image_px, 3), generator=generator, dtype=torch.uint8)
    return Twin(row, ponder.embed(row.ids, frames), ponder.encode_row(row, frames))


def is_whole(ponder: Ponder, row: Row, cut: int) -> bool:
    """An append may not begin or end inside an image."""
    pad = ponder.format.vocabulary.image_pad
    return cut == len(row.ids) or not (row.ids[cut] == pad == row.ids[cut - 1])


def go_astray(ponder: Ponder, session: Session) -> None:
    saved = session.save()
    session.append([5, 6, 7], 3.0 * ponder.embed([5, 6, 7]))
    session.restore(saved)


# Always the same draws: a rare network of random weights amplifies one rounding of its input to half the tolerance.
@settings(deadline=None, max_examples=12, derandomize=True)
@given(
    config=configs(),
    buckets=st.sampled_from([(1, 16, 64), (4, 40), (1, 7), (512,)]),
    steps=st.lists(st.tuples(*[st.integers(0, 40)] * NUM_ROWS), min_size=1, max_size=6),
    astray=st.sets(st.integers(0, 5), max_size=2),
)
@torch.inference_mode()
def test_rows_of_any_lengths_in_any_pieces_are_what_transformers_encodes(
    config: PonderConfig, buckets: tuple[int, ...], steps: list[tuple[int, ...]], astray: set[int]
) -> None:
    ponder = Ponder.random(config, VOCABULARY, seed=1)
    twins = [twin(ponder, index) for index in range(NUM_ROWS)]
    runner = Runner(ponder, num_slots=NUM_ROWS, max_tokens=max(len(t.row.ids) for t in twins) + 3, buckets=buckets)
    sessions = [runner.open(str(index)) for index in range(NUM_ROWS)]
    hidden: list[list[torch.Tensor]] = [[] for _ in twins]
    for number, sizes in enumerate([*steps, (10_000,) * NUM_ROWS]):
        appends, rows = [], []
        for index, (one, session, size) in enumerate(zip(twins, sessions, sizes, strict=True)):
            first = session.num_tokens
            end = min(first + size, len(one.row.ids))
            while not is_whole(ponder, one.row, end):
                end += 1
            if end > first:
                appends.append(Append(session=session, ids=one.row.ids[first:end], embeds_TH=one.embeds_TH[first:end]))
                rows.append(index)
        for index, hidden_TH in zip(rows, runner.append(appends), strict=True):
            hidden[index].append(hidden_TH)
        if number in astray:
            go_astray(ponder, sessions[number % NUM_ROWS])
    for one, pieces, session in zip(twins, hidden, sessions, strict=True):
        actual_TH = torch.cat(pieces)
        assert session.ids == list(one.row.ids)
        assert (actual_TH - one.expected_TH).abs().max() < TOLERANCE
        assert torch.equal(ponder.logits(actual_TH).argmax(-1), ponder.logits(one.expected_TH).argmax(-1))


@pytest.mark.parametrize("second", [(17, 0, 30), (1, 0, 1)])
@torch.inference_mode()
def test_garbage_in_pads_and_idle_rows_changes_nothing(second: tuple[int, ...]) -> None:
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(64, 64)), VOCABULARY, seed=1)
    twins = [twin(ponder, index) for index in range(NUM_ROWS)]
    memory = Runner(ponder, num_slots=NUM_ROWS, max_tokens=300).memory
    generator = torch.Generator().manual_seed(0)
    done = [0] * NUM_ROWS
    for counts in ((40, 7, 60), second, tuple(len(t.row.ids) - 40 for t in twins)):
        embeds_BTH = 5.0 * torch.randn(NUM_ROWS, max(counts), ponder.hidden_size, generator=generator)
        positions_3BT = np.full((3, NUM_ROWS, max(counts)), 9999)
        places = []
        for index, (one, first, wished) in enumerate(zip(twins, done, counts, strict=True)):
            count = min(wished, len(one.row.ids) - first)
            embeds_BTH[index, :count] = one.embeds_TH[first : first + count]
            positions_3BT[:, index, :count] = ponder.format.positions(one.row.ids)[0][1:, first : first + count]
            places.append(Place(slot=index, num_past=first, num_new=count, num_wanted=count))
        states_before = [[state.clone() for state in memory.states(slot)] for slot in range(NUM_ROWS)]
        text_model = ponder.qwen.model.language_model
        hidden = decode(text_model, memory, places, embeds_BTH, torch.from_numpy(positions_3BT))
        for one, place, hidden_TH, before in zip(twins, places, hidden, states_before, strict=True):
            expected_TH = one.expected_TH[place.num_past : place.num_past + place.num_new]
            torch.testing.assert_close(hidden_TH, expected_TH, rtol=0, atol=TOLERANCE)
            is_idle = all(map(torch.equal, memory.states(place.slot), before))
            assert is_idle == (place.num_new == 0)
            done[place.slot] += place.num_new


@pytest.mark.parametrize(("num_queries", "piece"), [(0, 5), (45, 600)])
@torch.inference_mode()
def test_in_bfloat16_appending_adds_no_error_of_its_own(num_queries: int, piece: int) -> None:
    """Against float32, an appended row is as good as transformers' own bfloat16 over the whole row.

    The second one is long enough for attention to take it in two windows, on a CPU that multiplies bfloat16 fast.
    """
    config = replace(tiny_cpu(), image_px=(64, 64))
    exact, rounded = (Ponder.random(config, VOCABULARY, seed=1, dtype=t) for t in (torch.float32, torch.bfloat16))
    row = episode(exact, 2, num_queries)
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (row.num_images, 64, 64, 3), generator=generator, dtype=torch.uint8)
    expected_TH = exact.encode_row(row, frames)
    session = Runner(rounded, num_slots=1, max_tokens=1000).open("a")
    embeds_TH = rounded.embed(row.ids, frames)
    bounds = [0]
    while bounds[-1] < len(row.ids):
        bounds.append(next(i for i in range(min(bounds[-1] + piece, len(row.ids)), 2000) if is_whole(rounded, row, i)))
    pieces = [session.append(row.ids[a:b], embeds_TH[a:b]) for a, b in pairwise(bounds)]
    appended = (torch.cat(pieces).float() - expected_TH).norm() / expected_TH.norm()
    at_once = (rounded.encode_row(row, frames).float() - expected_TH).norm() / expected_TH.norm()
    assert appended < 1.1 * at_once
