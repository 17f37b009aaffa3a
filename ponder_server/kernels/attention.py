"""Attention of a short append over slots where they lie, split over keys, and the output gate.

The kernels read the lengths on the device, so one graph serves every length. The twin gathers what it reads; its shape
is that of a bucket of positions.

# B rows, T tokens of a row with its padding, W tokens that ask, Q query heads, G key heads, D head size, N slots of S
# P positions that the twin reads
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import block_size, check_tensor, kernel, tl
from ponder_server.kernels.rotate_store import Window

_PROGRAMS = 128
"""Programs that fill a GPU: fewer would leave processors idle while each reads the whole past."""
_MOST_SPLITS = 32
_BLOCK_POSITIONS = 64


def attend_eager(
    queries_BTQD: Tensor,
    query_gate_BTX: Tensor,
    keys_NGSD: Tensor,
    values_NGSD: Tensor,
    token_BW: Tensor,
    window: Window,
    num_positions: int,
) -> Tensor:
    """Gated output (B, W, Q D) of the tokens ``token_BW``, which see the past and what came before them.

    ``num_positions``: the twin reads so many of a slot's first positions; at least as many as are valid.
    """
    num_rows, _, num_heads, size = queries_BTQD.shape
    num_key_heads = keys_NGSD.shape[1]
    position_P = torch.arange(num_positions, device=token_BW.device)
    # Positions past the last valid one hold garbage, which may be NaN: the first one is read in their place.
    seen_BP = position_P * (position_P < (window.num_past_B + window.num_new_B)[:, None])
    head_G1 = torch.arange(num_key_heads, device=token_BW.device)[:, None]
    keys, values = (
        memory[window.slot_B[:, None, None], head_G1, seen_BP[:, None]] for memory in (keys_NGSD, values_NGSD)
    )
    row_B1 = torch.arange(num_rows, device=token_BW.device)[:, None]
    queries_BQWD = queries_BTQD[row_B1, token_BW].transpose(1, 2)
    gate_BWX = query_gate_BTX[row_B1, token_BW].unflatten(-1, (num_heads, 2 * size))[..., size:].flatten(2)
    # Padding attends to something too, so that no row is NaN.
    is_hidden_BWP = position_P > (window.num_past_B[:, None] + token_BW)[..., None]
    bias_BWP = torch.zeros_like(is_hidden_BWP, dtype=queries_BTQD.dtype).masked_fill_(is_hidden_BWP, float("-inf"))
    seen_BQWD = _attend(queries_BQWD, keys, values, bias_BWP)
    return seen_BQWD.transpose(1, 2).reshape(gate_BWX.shape) * gate_BWX.sigmoid()


def _attend(queries_BQWD: Tensor, keys_BGPD: Tensor, values_BGPD: Tensor, bias_BWP: Tensor) -> Tensor:
    """Attention output (B, Q, W, D). Key heads become rows and their query heads the heads: torch's kernels with masks
    do not support grouped heads, and repeating the keys would copy them for every query head."""
    num_rows, num_heads, num_queries, size = queries_BQWD.shape
    num_key_heads = keys_BGPD.shape[1]
    group = num_heads // num_key_heads

    def shared(x_BGPD: Tensor) -> Tensor:
        return x_BGPD.flatten(0, 1)[:, None].expand(-1, group, -1, -1)

    bias = bias_BWP[:, None].expand(-1, num_key_heads, -1, -1).flatten(0, 1)[:, None].expand(-1, group, -1, -1)
    queries = queries_BQWD.reshape(num_rows * num_key_heads, group, num_queries, size)
    seen = F.scaled_dot_product_attention(queries, shared(keys_BGPD), shared(values_BGPD), attn_mask=bias)
    return seen.reshape(queries_BQWD.shape)  # a GPU's kernels leave the heads innermost: no view


def attend_fused(
    queries_BTQD: Tensor,
    query_gate_BTX: Tensor,
    keys_NGSD: Tensor,
    values_NGSD: Tensor,
    token_BW: Tensor,
    window: Window,
    num_positions: int,
) -> Tensor:
    """`attend_eager` in two launches: shares of the past, then their sum. Reads what is valid, whatever
    ``num_positions`` is.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, length, num_heads, size = queries_BTQD.shape
    num_key_heads, slot_positions = keys_NGSD.shape[1:3]
    num_asking, dtype = token_BW.shape[1], queries_BTQD.dtype
    check_tensor("queries", queries_BTQD, (num_rows, length, num_heads, size), dtype)
    check_tensor("query_gate", query_gate_BTX, (num_rows, length, num_heads * 2 * size), dtype)
    check_tensor("token", token_BW, (num_rows, num_asking), torch.long)
    for name, memory in (("keys", keys_NGSD), ("values", values_NGSD)):
        check_tensor(name, memory, tuple(keys_NGSD.shape), dtype)
    num_shared = num_asking * num_heads // num_key_heads  # rows of one key head
    block = min(max(block_size(num_shared), 16), 64)
    num_blocks = -(-num_shared // block)
    splits = min(_MOST_SPLITS, block_size(-(-_PROGRAMS // (num_rows * num_key_heads * num_blocks))))
    parts = torch.empty(num_rows, splits, num_asking, num_heads, size, device=queries_BTQD.device)
    weights = torch.empty(num_rows, splits, num_asking, num_heads, device=queries_BTQD.device)
    _attend_split[(num_rows * num_key_heads, splits, num_blocks)](
        queries_BTQD,
        keys_NGSD,
        values_NGSD,
        token_BW,
        *window,
        parts,
        weights,
        length,
        num_asking,
        slot_positions,
        HEADS=num_heads,
        KEY_HEADS=num_key_heads,
        SIZE=size,
        SPLITS=splits,
        BLOCK_ROWS=block,
        BLOCK_POSITIONS=_BLOCK_POSITIONS,
        LOG2_SCALE=size**-0.5 * 1.4426950408889634,
        PRECISION="ieee" if dtype == torch.float32 else "tf32",
        num_warps=8 if block == 64 else 4,  # with 4, 64 rows spill
        num_stages=2,  # three fill a processor's shared memory
    )
    out_BWX = query_gate_BTX.new_empty(num_rows, num_asking, num_heads * size)
    _join_splits[(num_rows, num_asking, num_heads)](
        parts,
        weights,
        query_gate_BTX,
        token_BW,
        out_BWX,
        length,
        HEADS=num_heads,
        SIZE=size,
        SPLITS=splits,
    )
    return out_BWX


@kernel
def _attend_split(
    queries_ptr: tl.tensor,
    keys_ptr: tl.tensor,
    values_ptr: tl.tensor,
    token_ptr: tl.tensor,
    slot_ptr: tl.tensor,
    num_past_ptr: tl.tensor,
    num_new_ptr: tl.tensor,
    parts_ptr: tl.tensor,
    weights_ptr: tl.tensor,
    length: tl.tensor,
    num_asking: tl.tensor,
    slot_positions: tl.tensor,
    HEADS: tl.constexpr,
    KEY_HEADS: tl.constexpr,
    SIZE: tl.constexpr,
    SPLITS: tl.constexpr,
    BLOCK_ROWS: tl.constexpr,
    BLOCK_POSITIONS: tl.constexpr,
    LOG2_SCALE: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    """One share of the keys: its normalised output, and the base-2 logarithm of its sum of exponentials."""
    GROUP: tl.constexpr = HEADS // KEY_HEADS
    row, key_head = (tl.program_id(0) // KEY_HEADS).to(tl.int64), tl.program_id(0) % KEY_HEADS
    split = tl.program_id(1)
    r = tl.program_id(2) * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    asking, head = r // GROUP, key_head * GROUP + r % GROUP
    is_row = asking < num_asking
    token = tl.load(token_ptr + row * num_asking + asking, mask=is_row, other=0).to(tl.int32)
    num_past = tl.load(num_past_ptr + row).to(tl.int32)
    num_valid = num_past + tl.load(num_new_ptr + row).to(tl.int32)
    share = tl.cdiv(tl.cdiv(num_valid, SPLITS), BLOCK_POSITIONS) * BLOCK_POSITIONS
    first = split * share
    end = tl.minimum(first + share, tl.minimum(num_valid, num_past + tl.max(token, axis=0) + 1))
    d = tl.arange(0, SIZE)
    query_at = ((row * length + token) * HEADS + head) * SIZE
    queries = tl.load(queries_ptr + query_at[:, None] + d[None, :], mask=is_row[:, None], other=0.0)
    slot = tl.load(slot_ptr + row).to(tl.int64)
    slot_at = (slot * KEY_HEADS + key_head) * slot_positions
    highest = tl.full([BLOCK_ROWS], -1e30, tl.float32)
    total = tl.zeros([BLOCK_ROWS], tl.float32)
    seen = tl.zeros([BLOCK_ROWS, SIZE], tl.float32)
    for start in range(first, end, BLOCK_POSITIONS):
        position = start + tl.arange(0, BLOCK_POSITIONS)
        is_inside = position < end
        at = (slot_at + position) * SIZE
        keys = tl.load(keys_ptr + at[None, :] + d[:, None], mask=is_inside[None, :], other=0.0)
        scores = tl.dot(queries, keys, input_precision=PRECISION) * LOG2_SCALE
        is_visible = (position[None, :] <= num_past + token[:, None]) & is_inside[None, :]
        scores = tl.where(is_visible, scores, -1e30)
        higher = tl.maximum(highest, tl.max(scores, axis=1))
        exponentials = tl.where(is_visible, tl.exp2(scores - higher[:, None]), 0.0)
        kept = tl.exp2(highest - higher)
        total = total * kept + tl.sum(exponentials, axis=1)
        values = tl.load(values_ptr + at[:, None] + d[None, :], mask=is_inside[:, None], other=0.0)
        seen = seen * kept[:, None] + tl.dot(exponentials.to(values.dtype), values, input_precision=PRECISION)
        highest = higher
    out_at = ((row * SPLITS + split) * num_asking + asking) * HEADS + head
    # A share in which nothing is visible has parts of zeros and no weight.
    weight = tl.where(total > 0.0, highest + tl.log2(tl.maximum(total, 1e-30)), -1e30)
    tl.store(weights_ptr + out_at, weight, mask=is_row)
    seen = seen / tl.maximum(total, 1e-30)[:, None]
    tl.store(parts_ptr + out_at[:, None] * SIZE + d[None, :], seen, mask=is_row[:, None])


@kernel
def _join_splits(
    parts_ptr: tl.tensor,
    weights_ptr: tl.tensor,
    query_gate_ptr: tl.tensor,
    token_ptr: tl.tensor,
    out_ptr: tl.tensor,
    length: tl.tensor,
    HEADS: tl.constexpr,
    SIZE: tl.constexpr,
    SPLITS: tl.constexpr,
) -> None:
    row, asking, head = tl.program_id(0).to(tl.int64), tl.program_id(1), tl.program_id(2)
    num_asking = tl.num_programs(1)
    s, d = tl.arange(0, SPLITS), tl.arange(0, SIZE)
    at = ((row * SPLITS + s) * num_asking + asking) * HEADS + head
    weights = tl.load(weights_ptr + at)
    weights = tl.exp2(weights - tl.max(weights, axis=0))
    parts = tl.load(parts_ptr + at[:, None] * SIZE + d[None, :])
    dtype = out_ptr.dtype.element_ty
    seen = (tl.sum(parts * weights[:, None], axis=0) / tl.sum(weights, axis=0)).to(dtype).to(tl.float32)
    token = tl.load(token_ptr + row * num_asking + asking)
    gate_at = ((row * length + token) * HEADS + head) * 2 * SIZE + SIZE
    gate = tl.sigmoid(tl.load(query_gate_ptr + gate_at + d).to(tl.float32)).to(dtype).to(tl.float32)
    tl.store(out_ptr + ((row * num_asking + asking) * HEADS + head) * SIZE + d, (seen * gate).to(dtype))
