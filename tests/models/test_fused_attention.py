"""Attention with a head's own keys: the twin of transformers' with groups, forward and backward."""

from __future__ import annotations

import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.fused_attention import NAME, fuse_attention
from dual_system.models.ponder.network import Ponder


def hidden_and_gradient(ponder: Ponder) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    embeds_BTH = torch.randn(2, 40, ponder.hidden_size, generator=generator, requires_grad=True)
    positions_4BT = torch.arange(40).expand(4, 2, 40)
    hidden_BTH = ponder(embeds_BTH, positions_4BT)
    hidden_BTH.square().sum().backward()
    assert embeds_BTH.grad is not None
    return hidden_BTH.detach(), embeds_BTH.grad


def test_fused_equals_grouped() -> None:
    ponder = Ponder.random(tiny_cpu(), seed=0)
    text = ponder.qwen.config.text_config
    assert text.num_attention_heads > text.num_key_value_heads  # else nothing is repeated
    wanted = hidden_and_gradient(ponder)
    fuse_attention(ponder)
    found = hidden_and_gradient(ponder)
    names = {each.self_attn.config._attn_implementation for each in ponder.qwen.model.language_model.layers[3::4]}
    assert names == {NAME}
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_others_are_left_alone() -> None:
    fused, other = (Ponder.random(tiny_cpu(), seed=0) for _ in range(2))
    fuse_attention(fused)
    kinds = {
        layer.self_attn.config._attn_implementation
        for layer in other.qwen.model.language_model.layers
        if hasattr(layer, "self_attn")
    }
    assert kinds == {"sdpa"}
