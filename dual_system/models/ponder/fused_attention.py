"""PONDER's attention over whole rows in float32 on a GPU, by a fused kernel.

transformers hands grouped heads to torch as they are. Of its fused kernels only those for 16-bit numbers know groups:
in float32 torch then makes the whole table of weights. Here every head is given keys and values of its own first.
"""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from torch import Tensor
from transformers import AttentionInterface

from dual_system.models.ponder.network import Ponder

NAME = "pp_fused"


def fuse_attention(ponder: Ponder) -> None:
    """From now on all attention layers of ``ponder`` do so, in place, wherever no mask is given."""
    AttentionInterface.register(NAME, _attended)
    for layer in ponder.qwen.model.language_model.layers:
        if hasattr(layer, "self_attn"):
            layer.self_attn.config._attn_implementation = NAME


def _attended(
    module: Any,
    query_BhTD: Tensor,
    key_BkTD: Tensor,
    value_BkTD: Tensor,
    attention_mask: Tensor | None,
    dropout: float = 0.0,
    scaling: float | None = None,
    **_: Any,
) -> tuple[Tensor, None]:
    """transformers' signature: (B, heads, T, D) and fewer heads of keys and values; returns (B, T, heads, D)."""
    groups = query_BhTD.shape[1] // key_BkTD.shape[1]
    keys, values = (each.repeat_interleave(groups, dim=1) for each in (key_BkTD, value_BkTD))
    is_causal = attention_mask is None and query_BhTD.shape[2] > 1
    read = F.scaled_dot_product_attention(
        query_BhTD, keys, values, attn_mask=attention_mask, dropout_p=dropout, scale=scaling, is_causal=is_causal
    )
    return read.transpose(1, 2).contiguous(), None
