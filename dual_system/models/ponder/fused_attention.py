"""PONDER's attention over whole rows in float32 on a GPU, with a fused kernel.

transformers passes grouped-query heads to torch unexpanded, but only torch's 16-bit fused kernels support groups: in
float32 torch would materialise the attention matrix. Here keys and values are repeated for every query head first.
"""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from torch import Tensor
from transformers import AttentionInterface

from dual_system.models.ponder.network import Ponder

NAME = "pp_fused"


def fuse_attention(ponder: Ponder) -> None:
    """Switches all attention layers of ``ponder`` to the fused kernel, in place."""
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
    """transformers' attention interface: queries (B, h, T, D), fewer key and value heads; returns (B, T, h, D)."""
    groups = query_BhTD.shape[1] // key_BkTD.shape[1]
    keys, values = (each.repeat_interleave(groups, dim=1) for each in (key_BkTD, value_BkTD))
    is_causal = attention_mask is None and query_BhTD.shape[2] > 1
    read = F.scaled_dot_product_attention(
        query_BhTD, keys, values, attn_mask=attention_mask, dropout_p=dropout, scale=scaling, is_causal=is_causal
    )
    return read.transpose(1, 2).contiguous(), None
