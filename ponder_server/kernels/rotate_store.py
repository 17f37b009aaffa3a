"""Between an attention layer's projections and its attention: head norms, rotary positions, keys and values stored.

# B rows, T tokens of a row with its padding, Q query heads, G key heads of size D, R rotary dimensions, N slots of S
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl
from dual_system.models.ponder.mixers import rotate


class Projected(NamedTuple):
    """The projections of one attention layer."""

    query_gate_BTX: Tensor
    """(B, T, Q 2 D): of every head the query, then the gate."""
    keys_BTX: Tensor
    """(B, T, G D)"""
    values_BTX: Tensor
    """(B, T, G D)"""


class HeadNorms(NamedTuple):
    """Scales 1 + w of the norms of queries and keys, (D,) float32 each."""

    query_D: Tensor
    key_D: Tensor
    eps: float


class Window(NamedTuple):
    """Where the rows' new tokens are: their slots, and the lengths before them and of them. Tensors (B,)."""

    slot_B: Tensor
    num_past_B: Tensor
    num_new_B: Tensor


def rotate_store_eager(
    projected: Projected,
    norms: HeadNorms,
    cos_sin: tuple[Tensor, Tensor],
    keys_NGSD: Tensor,
    values_NGSD: Tensor,
    window: Window,
) -> Tensor:
    """Writes the valid tokens' keys and values into the slots; returns the queries (B, T, Q, D), normed and rotated."""
    size = keys_NGSD.shape[3]
    queries_BTQD = projected.query_gate_BTX.unflatten(-1, (-1, 2 * size))[..., :size]
    keys_BTGD, values_BTGD = (x.unflatten(-1, (-1, size)) for x in (projected.keys_BTX, projected.values_BTX))
    queries = _normed(queries_BTQD, norms.query_D, norms.eps).transpose(1, 2)
    keys = _normed(keys_BTGD, norms.key_D, norms.eps).transpose(1, 2)
    queries, keys = rotate(queries, keys, *cos_sin)
    token_T = torch.arange(keys_BTGD.shape[1], device=keys.device)
    # Padding repeats the first token, so that the order of writes does not matter: the slot may end before the padding
    # does, which has no place of its own.
    stored_BT = token_T * (token_T < window.num_new_B[:, None])
    place_BT = window.num_past_B[:, None] + stored_BT
    for memory, new_BTGD in ((keys_NGSD, keys.transpose(1, 2)), (values_NGSD, values_BTGD)):
        valid_BTGD = new_BTGD.gather(1, stored_BT[:, :, None, None].expand(new_BTGD.shape))
        memory[window.slot_B[:, None], :, place_BT] = valid_BTGD
    return queries.transpose(1, 2)


def _normed(x: Tensor, scale_D: Tensor, eps: float) -> Tensor:
    return (torch.nn.functional.rms_norm(x.float(), x.shape[-1:], None, eps) * scale_D).to(x.dtype)


def rotate_store_fused(
    projected: Projected,
    norms: HeadNorms,
    cos_sin: tuple[Tensor, Tensor],
    keys_NGSD: Tensor,
    values_NGSD: Tensor,
    window: Window,
) -> Tensor:
    """`rotate_store_eager` in one launch, a program per token and head.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, length, width = projected.query_gate_BTX.shape
    _, num_key_heads, num_positions, size = keys_NGSD.shape
    num_heads, dtype = width // (2 * size), keys_NGSD.dtype
    rotary = cos_sin[0].shape[-1]
    check_tensor("query_gate", projected.query_gate_BTX, (num_rows, length, num_heads * 2 * size), dtype)
    for name, tensor in (("keys", projected.keys_BTX), ("values", projected.values_BTX)):
        check_tensor(name, tensor, (num_rows, length, num_key_heads * size), dtype)
    for name, memory in (("stored keys", keys_NGSD), ("stored values", values_NGSD)):
        check_tensor(name, memory, tuple(keys_NGSD.shape), dtype)
    for name, scale in (("query norm", norms.query_D), ("key norm", norms.key_D)):
        check_tensor(name, scale, (size,), torch.float32)
    for name, tensor in zip(("cos", "sin"), cos_sin, strict=True):
        check_tensor(name, tensor, (num_rows, length, rotary), dtype)
    queries_BTQD = projected.keys_BTX.new_empty(num_rows, length, num_heads, size)
    _rotate_store[(num_rows * length, num_heads + 2 * num_key_heads)](
        *projected,
        norms.query_D,
        norms.key_D,
        *cos_sin,
        keys_NGSD,
        values_NGSD,
        *window,
        queries_BTQD,
        length,
        num_positions,
        HEADS=num_heads,
        KEY_HEADS=num_key_heads,
        SIZE=size,
        ROTARY=rotary,
        EPS=norms.eps,
        num_warps=1,
    )
    return queries_BTQD


@kernel
def _rotate_store(
    query_gate_ptr: tl.tensor,
    keys_ptr: tl.tensor,
    values_ptr: tl.tensor,
    query_norm_ptr: tl.tensor,
    key_norm_ptr: tl.tensor,
    cos_ptr: tl.tensor,
    sin_ptr: tl.tensor,
    stored_keys_ptr: tl.tensor,
    stored_values_ptr: tl.tensor,
    slot_ptr: tl.tensor,
    num_past_ptr: tl.tensor,
    num_new_ptr: tl.tensor,
    queries_ptr: tl.tensor,
    length: tl.tensor,
    num_positions: tl.tensor,
    HEADS: tl.constexpr,
    KEY_HEADS: tl.constexpr,
    SIZE: tl.constexpr,
    ROTARY: tl.constexpr,
    EPS: tl.constexpr,
) -> None:
    at, head = tl.program_id(0).to(tl.int64), tl.program_id(1)
    row, token = at // length, at % length
    d = tl.arange(0, SIZE)
    # The other one of a rotated pair, which lies half of the rotary dimensions away.
    other = tl.where(d < ROTARY // 2, d + ROTARY // 2, tl.where(d < ROTARY, d - ROTARY // 2, d))
    is_valid = token < tl.load(num_new_ptr + row)
    place = tl.load(num_past_ptr + row).to(tl.int64) + token
    slot = tl.load(slot_ptr + row).to(tl.int64)
    dtype = queries_ptr.dtype.element_ty
    if head < HEADS + KEY_HEADS:
        is_query = head < HEADS
        if is_query:
            x_at, norm_at = query_gate_ptr + (at * HEADS + head) * 2 * SIZE, query_norm_ptr
        else:
            x_at, norm_at = keys_ptr + (at * KEY_HEADS + head - HEADS) * SIZE, key_norm_ptr
        x, y = tl.load(x_at + d).to(tl.float32), tl.load(x_at + other).to(tl.float32)
        scale = tl.rsqrt(tl.sum(x * x, axis=0) / SIZE + EPS)
        x = (x * scale * tl.load(norm_at + d)).to(dtype).to(tl.float32)
        y = (y * scale * tl.load(norm_at + other)).to(dtype).to(tl.float32)
        is_rotary = d < ROTARY
        cos = tl.load(cos_ptr + at * ROTARY + d, mask=is_rotary, other=1.0).to(tl.float32)
        sin = tl.load(sin_ptr + at * ROTARY + d, mask=is_rotary, other=0.0).to(tl.float32)
        rotated = (x * cos + tl.where(d < ROTARY // 2, -y, y) * sin).to(dtype)
        if is_query:
            tl.store(queries_ptr + (at * HEADS + head) * SIZE + d, rotated)
        elif is_valid:
            key_at = (slot * KEY_HEADS + head - HEADS) * num_positions + place
            tl.store(stored_keys_ptr + key_at * SIZE + d, rotated)
    elif is_valid:
        value_head = head - HEADS - KEY_HEADS
        value = tl.load(values_ptr + (at * KEY_HEADS + value_head) * SIZE + d)
        value_at = (slot * KEY_HEADS + value_head) * num_positions + place
        tl.store(stored_values_ptr + value_at * SIZE + d, value)
