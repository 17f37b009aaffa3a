"""The roofline counts what a piece multiplies and reads."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from benchmarks.roofline import Ceilings, Piece, measure_ceilings, piece_of


def test_a_layer_is_counted_once_however_often_it_is_read() -> None:
    layer, table = nn.Linear(8, 4), nn.Embedding(1000, 8)
    ids = torch.tensor([[1, 2, 3]])
    piece = piece_of(lambda: [layer(table(ids)) for _ in range(2)])
    assert piece.flops == 2 * (2 * 3 * 8 * 4)
    assert piece.weight_bytes == 4 * (8 * 4 + 4)


@pytest.mark.parametrize(
    ("piece", "ms"), [(Piece(flops=2_000, weight_bytes=1), 2.0), (Piece(flops=1, weight_bytes=9), 9.0)]
)
def test_the_slower_of_the_two_decides(piece: Piece, ms: float) -> None:
    assert piece.least_ms(Ceilings(flops_per_s=1e6, bytes_per_s=1e3)) == pytest.approx(ms)


def test_ceilings_are_measured() -> None:
    ceilings = measure_ceilings(torch.device("cpu"), torch.float32)
    assert ceilings.flops_per_s > 1e8
    assert ceilings.bytes_per_s > 1e7
