"""Int8 layers: near the exact ones, and a quarter of the bytes; only those that were asked for."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from dual_system.models.int8 import Int8Linear
from dual_system.models.narrow_linear import quantise_where


@given(seed=st.integers(0, 2**31), rows=st.integers(1, 9), columns=st.integers(1, 9), scale=st.floats(1e-6, 1e6))
@settings(deadline=None)
def test_no_weight_is_off_by_more_than_half_a_step(seed: int, rows: int, columns: int, scale: float) -> None:
    linear = nn.Linear(columns, rows)
    with torch.no_grad():
        linear.weight.copy_(scale * torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed)))
    narrow = Int8Linear(linear)
    error = (narrow.weight_OI.float() * narrow.scale_O[:, None] - linear.weight).abs()
    assert (error <= narrow.scale_O[:, None] * 0.501).all()
    x = torch.eye(columns)
    torch.testing.assert_close(narrow(x), x @ (narrow.weight_OI.float() * narrow.scale_O[:, None]).T + linear.bias)


def test_a_row_of_zeros_stays_one() -> None:
    linear = nn.Linear(3, 2, bias=False)
    nn.init.zeros_(linear.weight)
    assert torch.equal(Int8Linear(linear)(torch.ones(1, 3)), torch.zeros(1, 2))


def test_only_what_was_asked_for_is_narrow() -> None:
    model = nn.Sequential(nn.Linear(4, 3), nn.Sequential(nn.Linear(3, 2), nn.LayerNorm(2)))
    x = torch.ones(1, 4)
    exact = model(x)
    assert quantise_where(model, lambda name: name == "1.0.weight", Int8Linear) == 3 * 6
    assert [type(child) for child in (model[0], *model[1])] == [nn.Linear, Int8Linear, nn.LayerNorm]
    assert model(x).shape == exact.shape
