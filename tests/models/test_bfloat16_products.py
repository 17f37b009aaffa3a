"""Products in bfloat16: the same layer to within its rounding, forward and back, and nothing else is touched."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from dual_system.models.bfloat16_products import Bfloat16Linear, multiply_in_bfloat16

_ROUNDING = 2**-8


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Of sums of many rounded products."""
    return bool((one - other).norm() < 2 * _ROUNDING * other.norm())


@pytest.mark.parametrize("bias", [True, False])
def test_its_product_and_gradients_are_those_of_float32_rounded(bias: bool) -> None:
    torch.manual_seed(0)
    exact = nn.Linear(96, 200, bias=bias)
    narrow = copy.deepcopy(exact)
    multiply_in_bfloat16(narrow)
    assert type(narrow) is Bfloat16Linear
    found = []
    for layer in (exact, narrow):
        x = torch.randn(3, 50, 96, generator=torch.Generator().manual_seed(1)).requires_grad_()
        y = layer(x)
        assert y.dtype == torch.float32
        y.square().mean().backward()
        found.append([y.detach(), x.grad, *(p.grad for p in layer.parameters())])
    assert all(each.dtype == torch.float32 for each in found[1])
    assert all(close(narrow_one, exact_one) for exact_one, narrow_one in zip(*found, strict=True))
    assert not torch.equal(found[0][0], found[1][0])


def test_small_layers_and_names_stay() -> None:
    model = nn.Sequential(nn.Linear(64, 8), nn.Linear(64, 64), nn.Conv1d(64, 64, 1), nn.LayerNorm(64))
    before = model.state_dict()
    multiply_in_bfloat16(model)
    assert [type(each) for each in model] == [nn.Linear, Bfloat16Linear, nn.Conv1d, nn.LayerNorm]
    assert list(model.state_dict()) == list(before)
    assert model[1](torch.ones(64)).shape == (64,)


def test_weights_that_are_narrow_already_are_refused() -> None:
    with pytest.raises(ValueError, match="float32 weights only"):
        multiply_in_bfloat16(nn.Linear(64, 64, dtype=torch.bfloat16))


def test_what_is_frozen_asks_for_no_gradient() -> None:
    layer = nn.Linear(64, 64)
    multiply_in_bfloat16(layer)
    layer.requires_grad_(False)
    x = torch.randn(2, 64, requires_grad=True)
    layer(x).sum().backward()
    assert layer.weight.grad is None
    assert x.grad is not None
