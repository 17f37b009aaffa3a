"""Words of places in networks from scratch: what pretraining would have told them of each other."""

from __future__ import annotations

import torch
from torch import Tensor

from dual_system.models.ponder.coordinates import PLACE_WORDS
from dual_system.training.place_words import draw_place_words

PER_AXIS = len(PLACE_WORDS) // 2
IDS = [3 + 2 * index for index in range(len(PLACE_WORDS))][::-1]  # any, in any order


def drawn(seed: int = 0) -> tuple[Tensor, Tensor]:
    before = torch.randn(2 * len(PLACE_WORDS) + 5, 128, generator=torch.Generator().manual_seed(7)) / 8
    after = before.clone()
    draw_place_words(after, IDS, torch.Generator().manual_seed(seed))
    return before, after


def alike(rows_PW: Tensor, distance: int) -> float:
    return float(torch.cosine_similarity(rows_PW[:-distance], rows_PW[distance:], dim=-1).mean())


def test_near_places_have_near_rows_and_far_ones_have_not() -> None:
    _before, after = drawn()
    for of_axis in (IDS[:PER_AXIS], IDS[PER_AXIS:]):
        likeness = [alike(after[of_axis], distance) for distance in (1, 4, 8, 16, 64)]
        assert likeness == sorted(likeness, reverse=True)
        assert likeness[0] > 0.99
        assert likeness[2] > 0.75
        assert likeness[-1] < 0.4


def test_the_two_axes_have_rows_of_their_own() -> None:
    _before, after = drawn()
    across = torch.cosine_similarity(after[IDS[:PER_AXIS]], after[IDS[PER_AXIS:]], dim=-1)
    assert across.abs().mean() < 0.3


def test_a_table_keeps_its_rms_and_all_other_rows() -> None:
    before, after = drawn()
    others = sorted(set(range(len(before))) - set(IDS))
    assert torch.equal(after[others], before[others])
    torch.testing.assert_close(after[IDS].square().mean(), before.square().mean())


def test_rows_follow_from_the_seed() -> None:
    assert torch.equal(drawn()[1], drawn()[1])
    assert not torch.equal(drawn()[1], drawn(1)[1])


def test_two_tables_of_one_generator_share_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    tables = [torch.ones(len(PLACE_WORDS), 128) for _ in range(2)]
    for table in tables:
        draw_place_words(table, list(range(len(PLACE_WORDS))), generator)
    assert float(torch.cosine_similarity(*tables, dim=-1).abs().mean()) < 0.3
