"""Attention of a few new tokens over everything before them, reading the cache where it lies.

The queries are always those of the *last* positions, so visibility needs no mask: all of them see the past, and among
themselves they are causal. The two parts are computed apart and joined by their log-sum-exp, which is exact. A mask
would be queries x context floats per fire, and repeating the key heads would copy the whole cache.

# H query heads, G key heads, H = G * group; M queries, S positions, P = S - M past ones, D head dimension
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

# Internal, but the one CPU attention that returns its log-sum-exp; the tests compare it with the public function.
_flash_cpu: Any = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu


def attend(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor) -> Tensor:
    """What the last M of S positions see (H, M, D); scores are scaled by D ** -0.5."""
    if queries_HMD.device.type == "cpu":
        return attend_in_parts(queries_HMD, keys_GSD, values_GSD)
    return attend_masked(queries_HMD, keys_GSD, values_GSD)


def attend_in_parts(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor) -> Tensor:
    """On a CPU: past and present apart, nothing of the past copied."""
    num_heads, num_queries, head_dim = queries_HMD.shape
    num_key_heads, num_past = keys_GSD.shape[0], keys_GSD.shape[1] - num_queries
    group = num_heads // num_key_heads
    recent_keys = keys_GSD[:, num_past:].repeat_interleave(group, dim=0)
    recent_values = values_GSD[:, num_past:].repeat_interleave(group, dim=0)
    recent, recent_lse = _flash_cpu(queries_HMD[None], recent_keys[None], recent_values[None], is_causal=True)
    if num_past == 0:
        return recent[0]  # type: ignore[no-any-return]
    # Without a mask every query is alike: the heads that share a key head are one longer list of queries.
    shared = queries_HMD.reshape(1, num_key_heads, group * num_queries, head_dim)
    past, past_lse = _flash_cpu(shared, keys_GSD[None, :, :num_past], values_GSD[None, :, :num_past])
    past = past.reshape(num_heads, num_queries, head_dim)
    share = torch.sigmoid(past_lse.reshape(num_heads, num_queries) - recent_lse[0])[..., None]
    return torch.lerp(recent[0].float(), past.float(), share).to(queries_HMD.dtype)


def attend_masked(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor) -> Tensor:
    """The same in one call of the public function, for devices whose kernels read a mask cheaply."""
    num_queries, num_positions = queries_HMD.shape[1], keys_GSD.shape[1]
    visible_MS = torch.ones(num_queries, num_positions, dtype=torch.bool, device=queries_HMD.device)
    visible_MS = visible_MS.tril_(diagonal=num_positions - num_queries)
    return F.scaled_dot_product_attention(
        queries_HMD[None], keys_GSD[None], values_GSD[None], attn_mask=visible_MS, enable_gqa=True
    )[0]
