"""RoPE of queries and keys in one pass over the packed projection, written in attention's layout."""

# B batch, T tokens, S slots of the key buffer, h query heads, g key heads, D head dim, C = D/2 pairs

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl
from dual_system.models.pi05.gemma import Rotation

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=1e-6),
    torch.bfloat16: Tolerance(rtol=2**-7, atol=2**-9),  # the same float32 arithmetic with fused multiply-adds
}


@dataclass(frozen=True, slots=True, eq=False)
class Slots:
    """One layer's keys and values, (B, g, S, D) each, and the first slot of these tokens."""

    keys: Tensor
    values: Tensor
    first: int


def empty_queries(qkv: Tensor, slots: Slots) -> Tensor:
    """Where the rotated queries of ``qkv`` go, (B, g, T * h/g, D)."""
    batch_size, num_kv_heads, _, head_dim = slots.keys.shape
    num_heads = qkv.shape[1] // head_dim - 2 * num_kv_heads
    num_rows = num_heads // num_kv_heads * (len(qkv) // batch_size)
    return qkv.new_empty(batch_size, num_kv_heads, num_rows, head_dim)


def rope_eager(qkv: Tensor, rotation: Rotation, queries: Tensor, slots: Slots) -> None:
    """Writes rotated queries, and rotated keys and plain values into T of the slots.

    ``qkv`` is (B * T, (h + 2g) * D), per token the heads of q, k and v. ``rotation`` holds (B, 1, T, C) float32.
    Queries are (B, g, T * h/g, D): heads that share a key head are rows, and those of a token lie side by side.
    """
    batch_size, num_kv_heads, num_rows, head_dim = queries.shape
    num_tokens = len(qkv) // batch_size
    num_heads = num_kv_heads * num_rows // num_tokens
    heads = qkv.view(batch_size, num_tokens, num_heads + 2 * num_kv_heads, head_dim).transpose(1, 2)
    q, k, v = heads.split([num_heads, num_kv_heads, num_kv_heads], dim=1)
    here = slice(slots.first, slots.first + num_tokens)
    grouped = rotation(q).unflatten(1, (num_kv_heads, -1)).transpose(2, 3)
    queries.view(grouped.shape).copy_(grouped)
    slots.keys[:, :, here].copy_(rotation(k))
    slots.values[:, :, here].copy_(v)


def rope_fused(qkv: Tensor, rotation: Rotation, queries: Tensor, slots: Slots) -> None:
    """`rope_eager` in one launch, one program per token.

    Raises:
        ValueError: shapes, dtypes or layouts do not match, or the tokens do not fit into the slots.
    """
    num_tokens, num_heads = check_rope(qkv, rotation, queries, slots)
    batch_size, num_kv_heads, num_slots, head_dim = slots.keys.shape
    _rope[(batch_size * num_tokens,)](
        qkv,
        rotation.cos,
        rotation.sin,
        queries,
        slots.keys,
        slots.values,
        num_tokens,
        num_slots,
        slots.first,
        Q_HEADS=num_heads,
        KV_HEADS=num_kv_heads,
        PAIRS=head_dim // 2,
        HEAD_BLOCK=block_size(num_heads + 2 * num_kv_heads),
        PAIR_BLOCK=block_size(head_dim // 2),
    )


def check_rope(qkv: Tensor, rotation: Rotation, queries: Tensor, slots: Slots) -> tuple[int, int]:
    """Tokens and query heads.

    Raises:
        ValueError: shapes, dtypes or layouts do not match, or the tokens do not fit into the slots.
    """
    batch_size, num_kv_heads, num_rows, head_dim = queries.shape
    num_slots, num_tokens = slots.keys.shape[2], max(1, len(qkv) // batch_size)
    num_heads = num_kv_heads * num_rows // num_tokens
    check_tensor("qkv", qkv, (batch_size * num_tokens, (num_heads + 2 * num_kv_heads) * head_dim), qkv.dtype)
    check_tensor("queries", queries, (batch_size, num_kv_heads, num_rows, head_dim), qkv.dtype)
    for name, buffer in (("keys", slots.keys), ("values", slots.values)):
        check_tensor(name, buffer, (batch_size, num_kv_heads, num_slots, head_dim), qkv.dtype)
    for name, table in (("cos", rotation.cos), ("sin", rotation.sin)):
        check_tensor(name, table, (batch_size, 1, num_tokens, head_dim // 2), torch.float32)
    if not 0 <= slots.first <= num_slots - num_tokens:
        raise ValueError(f"{num_tokens} tokens from slot {slots.first} on do not fit into {num_slots} slots")
    return num_tokens, num_heads


@kernel
def _rope(
    qkv_ptr: tl.tensor,
    cos_ptr: tl.tensor,
    sin_ptr: tl.tensor,
    q_ptr: tl.tensor,
    k_ptr: tl.tensor,
    v_ptr: tl.tensor,
    num_tokens: tl.tensor,
    num_slots: tl.tensor,
    first_slot: tl.tensor,
    Q_HEADS: tl.constexpr,
    KV_HEADS: tl.constexpr,
    PAIRS: tl.constexpr,
    HEAD_BLOCK: tl.constexpr,
    PAIR_BLOCK: tl.constexpr,
) -> None:
    row = tl.program_id(0).to(tl.int64)
    sample, token = row // num_tokens, row % num_tokens
    head = tl.arange(0, HEAD_BLOCK)[:, None]
    pair = tl.arange(0, PAIR_BLOCK)[None, :]
    is_pair = pair < PAIRS
    is_q = head < Q_HEADS
    is_k = (head >= Q_HEADS) & (head < Q_HEADS + KV_HEADS)
    is_v = (head >= Q_HEADS + KV_HEADS) & (head < Q_HEADS + 2 * KV_HEADS)

    inside = is_pair & (head < Q_HEADS + 2 * KV_HEADS)
    x_at = qkv_ptr + (row * (Q_HEADS + 2 * KV_HEADS) + head) * (2 * PAIRS) + pair
    first = tl.load(x_at, mask=inside, other=0.0).to(tl.float32)
    second = tl.load(x_at + PAIRS, mask=inside, other=0.0).to(tl.float32)
    cos = tl.load(cos_ptr + row * PAIRS + pair, mask=is_pair, other=0.0)
    sin = tl.load(sin_ptr + row * PAIRS + pair, mask=is_pair, other=0.0)
    # Pairs are (i, i + D/2), the half-split convention; values are copied.
    turned_first = tl.where(is_v, first, first * cos - second * sin).to(q_ptr.dtype.element_ty)
    turned_second = tl.where(is_v, second, second * cos + first * sin).to(q_ptr.dtype.element_ty)

    GROUP: tl.constexpr = Q_HEADS // KV_HEADS
    q_row = ((sample * KV_HEADS + head // GROUP) * num_tokens + token) * GROUP + head % GROUP
    q_at = q_ptr + q_row * (2 * PAIRS) + pair
    tl.store(q_at, turned_first, mask=is_q & is_pair)
    tl.store(q_at + PAIRS, turned_second, mask=is_q & is_pair)
    slot = first_slot + token
    k_at = k_ptr + ((sample * KV_HEADS + head - Q_HEADS) * num_slots + slot) * (2 * PAIRS) + pair
    tl.store(k_at, turned_first, mask=is_k & is_pair)
    tl.store(k_at + PAIRS, turned_second, mask=is_k & is_pair)
    v_at = v_ptr + ((sample * KV_HEADS + head - Q_HEADS - KV_HEADS) * num_slots + slot) * (2 * PAIRS) + pair
    tl.store(v_at, turned_first, mask=is_v & is_pair)
    tl.store(v_at + PAIRS, turned_second, mask=is_v & is_pair)
