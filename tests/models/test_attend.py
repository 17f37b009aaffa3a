"""Grouped attention of POUNCE: heads become rows, and on a CPU not one bit changes."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.pi05.gemma import attend


def grouped(q_BhTD: Tensor, k_BgSD: Tensor, v_BgSD: Tensor, visible: Tensor | None) -> Tensor:
    mixed = F.scaled_dot_product_attention(q_BhTD, k_BgSD, v_BgSD, attn_mask=visible, enable_gqa=True)
    return mixed.transpose(1, 2).flatten(2)


def case(heads: tuple[int, int], mask: str, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, heads[0], 20, 64, generator=generator).to(dtype)
    k, v = (torch.randn(2, heads[1], 68, 64, generator=generator).to(dtype) for _ in range(2))
    if mask == "none":
        return q, k, v, None
    visible = torch.rand(2, 1, 20 if mask == "by row" else 1, 68, generator=generator) > 0.3
    visible[..., 0] = True
    bias = torch.zeros_like(visible, dtype=dtype).masked_fill(~visible, float("-inf"))
    return q, k, v, visible if mask == "by key" else bias


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("heads", [(8, 1), (16, 8), (6, 2), (4, 4)])
@pytest.mark.parametrize("mask", ["none", "by key", "by row"])
def test_heads_as_rows_are_the_grouped_call_s_bits(heads: tuple[int, int], mask: str, dtype: torch.dtype) -> None:
    inputs = case(heads, mask, dtype)
    assert torch.equal(attend(*inputs), grouped(*inputs))


def test_training_on_a_cpu_keeps_the_bits_of_its_gradients() -> None:
    q, k, v, visible = case((8, 1), "by key", torch.float32)
    for x in (q, k, v):
        x.requires_grad_()
    ours, twin = (torch.autograd.grad(way(q, k, v, visible).square().sum(), (q, k, v)) for way in (attend, grouped))
    assert all(map(torch.equal, ours, twin))


def test_no_call_has_a_mask_and_grouped_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's fused GPU kernels refuse the two together, and the fallback takes five times as long."""
    calls = []

    def watched(query: Tensor, key: Tensor, value: Tensor, *, attn_mask: Tensor, enable_gqa: bool = False) -> Tensor:
        calls.append((query.shape[1] == key.shape[1], enable_gqa))
        return torch.zeros_like(query)

    monkeypatch.setattr(F, "scaled_dot_product_attention", watched)
    for heads in ((8, 1), (16, 8)):
        attend(*case(heads, "by key", torch.float32))
    assert calls == [(True, False)] * 2
