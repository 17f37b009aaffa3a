"""The norms of Qwen's query and key heads with their rotation, in place over the packed projection."""

# R = B * T rows (batch times tokens), h query heads, g key heads, D head dim, C = D/2 pairs

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl
from dual_system.models.pi05.gemma import Rotation

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=2e-6),
    torch.bfloat16: Tolerance(rtol=2**-6, atol=2**-7),  # both round the norm and the rotation
}


class HeadNorms(NamedTuple):
    """Scales of the norms of queries and keys, (D,) float32 each, and how many heads there are."""

    query_D: Tensor
    key_D: Tensor
    num_heads: int
    num_kv_heads: int
    eps: float


def head_rope_eager(qkv: Tensor, norms: HeadNorms, rotation: Rotation) -> None:
    """Normalises and rotates the queries and keys of ``qkv``, (R, (h + 2g) * D), in place; values stay.

    ``rotation`` holds (1, 1, T, C) float32: every sample's tokens have the same positions.
    """
    size, num_tokens = len(norms.query_D), rotation.cos.shape[2]
    heads = qkv.view(-1, num_tokens, qkv.shape[1] // size, size).transpose(1, 2)
    queries, keys, _ = heads.split([norms.num_heads, norms.num_kv_heads, norms.num_kv_heads], dim=1)
    for part, scale_D in ((queries, norms.query_D), (keys, norms.key_D)):
        normed = F.rms_norm(part.float(), scale_D.shape, scale_D, norms.eps).to(qkv.dtype)
        part.copy_(rotation(normed))


def head_rope_fused(qkv: Tensor, norms: HeadNorms, rotation: Rotation) -> None:
    """`head_rope_eager` in one launch, one program per token.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    size, num_tokens = len(norms.query_D), rotation.cos.shape[2]
    if len(qkv) % num_tokens:
        raise ValueError(f"qkv: expected a multiple of {num_tokens} rows, came {len(qkv)}")
    check_tensor("qkv", qkv, (len(qkv), (norms.num_heads + 2 * norms.num_kv_heads) * size), qkv.dtype)
    for name, scale in (("query norm", norms.query_D), ("key norm", norms.key_D)):
        check_tensor(name, scale, (size,), torch.float32)
    for name, table in (("cos", rotation.cos), ("sin", rotation.sin)):
        check_tensor(name, table, (1, 1, num_tokens, size // 2), torch.float32)
    _head_rope[(len(qkv),)](
        qkv,
        norms.query_D,
        norms.key_D,
        rotation.cos,
        rotation.sin,
        num_tokens,
        Q_HEADS=norms.num_heads,
        KV_HEADS=norms.num_kv_heads,
        PAIRS=size // 2,
        HEAD_BLOCK=block_size(norms.num_heads + norms.num_kv_heads),
        PAIR_BLOCK=block_size(size // 2),
        EPS=norms.eps,
    )


@kernel
def _head_rope(
    qkv_ptr: tl.tensor,
    query_norm_ptr: tl.tensor,
    key_norm_ptr: tl.tensor,
    cos_ptr: tl.tensor,
    sin_ptr: tl.tensor,
    num_tokens: tl.tensor,
    Q_HEADS: tl.constexpr,
    KV_HEADS: tl.constexpr,
    PAIRS: tl.constexpr,
    HEAD_BLOCK: tl.constexpr,
    PAIR_BLOCK: tl.constexpr,
    EPS: tl.constexpr,
) -> None:
    row = tl.program_id(0).to(tl.int64)
    head = tl.arange(0, HEAD_BLOCK)[:, None]
    pair = tl.arange(0, PAIR_BLOCK)[None, :]
    is_pair = pair < PAIRS
    is_inside = is_pair & (head < Q_HEADS + KV_HEADS)
    at = qkv_ptr + (row * (Q_HEADS + 2 * KV_HEADS) + head) * (2 * PAIRS) + pair
    first = tl.load(at, mask=is_inside, other=0.0).to(tl.float32)
    second = tl.load(at + PAIRS, mask=is_inside, other=0.0).to(tl.float32)
    mean = (tl.sum(first * first, axis=1) + tl.sum(second * second, axis=1)) / (2 * PAIRS)
    scale = tl.rsqrt(mean + EPS)[:, None]
    is_query = head < Q_HEADS
    first_scale = tl.where(
        is_query,
        tl.load(query_norm_ptr + pair, mask=is_pair, other=0.0),
        tl.load(key_norm_ptr + pair, mask=is_pair, other=0.0),
    )
    second_scale = tl.where(
        is_query,
        tl.load(query_norm_ptr + PAIRS + pair, mask=is_pair, other=0.0),
        tl.load(key_norm_ptr + PAIRS + pair, mask=is_pair, other=0.0),
    )
    dtype = qkv_ptr.dtype.element_ty
    first = (first * scale * first_scale).to(dtype).to(tl.float32)
    second = (second * scale * second_scale).to(dtype).to(tl.float32)
    turn_at = (row % num_tokens) * PAIRS + pair
    cos = tl.load(cos_ptr + turn_at, mask=is_pair, other=0.0)
    sin = tl.load(sin_ptr + turn_at, mask=is_pair, other=0.0)
    tl.store(at, (first * cos - second * sin).to(dtype), mask=is_inside)
    tl.store(at + PAIRS, (second * cos + first * sin).to(dtype), mask=is_inside)
