"""Attention of a run's tokens: rotation, the slots that are seen, and the tokens' own keys, written to their slots.

Blocks of slots that nobody sees, a missing camera's and the bucket's padding, are left out: a list on the device says
which are read, so one graph serves every list. A run of few tokens rotates its own keys where it reads them, and
shares the slots between programs; `rope` comes before a longer one.
"""

# B batch, T tokens, R = B * T rows, S attended slots, h query heads, g key heads, D head dim, C = D/2 pairs, Z splits

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl
from dual_system.models.pi05.gemma import Rotation
from pounce_server.kernels.rope import Slots, check_rope, empty_queries

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=2e-6),
    torch.bfloat16: Tolerance(rtol=2**-6, atol=2**-7),  # the twin keeps weights in float32, the kernel rounds them
}
MOST_ROTATED = 64
"""Tokens of a run that rotates its own keys: every program of the last share does it."""
_BLOCK_SLOTS = 64
_PROGRAMS = 128
"""Programs that fill a GPU."""
_MOST_SPLITS = 32
_LOG2_E = 1.4426950408889634

Rope: TypeAlias = Callable[[Tensor, Rotation, Tensor, Slots], None]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What the tokens of a run attend to: slots from ``first`` on, their own the last."""

    first: int
    bias: Tensor
    """(B, 1, 1, S): 0 for slots that are seen, else -inf; from a bool torch would make it again in every layer."""
    blocks: Tensor
    """(B, 1 + blocks) int32: how many blocks of stored slots hold one that is seen, and their numbers first."""

    @classmethod
    def blank(cls, slots: slice, num_tokens: int, batch_size: int, like: Tensor) -> Seen:
        """All of ``slots`` are seen; ``like`` gives dtype and device."""
        width = slots.stop - slots.start
        num_blocks = -(-_num_stored(width, num_tokens) // _BLOCK_SLOTS)
        counted = torch.arange(-1, num_blocks, device=like.device, dtype=torch.int32).repeat(batch_size, 1)
        counted[:, 0] = num_blocks
        return cls(slots.start, like.new_zeros(batch_size, 1, 1, width), counted)

    def place(self, visible_BS: Tensor, num_tokens: int) -> None:
        """Loads which of the slots are real."""
        self.bias.zero_().masked_fill_(~visible_BS[:, None, None, :], float("-inf"))
        stored_BS = visible_BS[:, : _num_stored(visible_BS.shape[1], num_tokens)]
        stored_BS = F.pad(stored_BS, (0, -stored_BS.shape[1] % _BLOCK_SLOTS))
        is_seen_BN = stored_BS.unflatten(1, (self.blocks.shape[1] - 1, _BLOCK_SLOTS)).any(dim=2)
        self.blocks[:, 0] = is_seen_BN.sum(dim=1)
        self.blocks[:, 1:] = is_seen_BN.int().argsort(dim=1, descending=True, stable=True)


def _num_stored(num_slots: int, num_tokens: int) -> int:
    """Slots that are read from memory: all, or all but the tokens' own."""
    return num_slots - (num_tokens if num_tokens <= MOST_ROTATED else 0)


def attend_eager(rope: Rope, qkv: Tensor, rotation: Rotation, slots: Slots, seen: Seen) -> Tensor:
    """Mixed values (R, h * D) of ``qkv``'s tokens, (R, (h + 2g) * D); their keys and values are written to ``slots``.

    ``rope`` writes them there: the twin or the kernel, whichever was taken. The heads that share a key head are rows.
    """
    queries = empty_queries(qkv, slots)
    rope(qkv, rotation, queries, slots)
    batch_size, num_kv_heads = slots.keys.shape[:2]
    num_tokens = len(qkv) // batch_size
    here = slice(seen.first, slots.first + num_tokens)
    keys, values = slots.keys[:, :, here], slots.values[:, :, here]
    mixed = F.scaled_dot_product_attention(queries, keys, values, attn_mask=seen.bias)
    mixed = mixed.reshape(batch_size, num_kv_heads, num_tokens, -1)  # a GPU's kernels leave the heads innermost
    return mixed.transpose(1, 2).reshape(len(qkv), -1)


def attend_fused(rope: Rope, qkv: Tensor, rotation: Rotation, slots: Slots, seen: Seen) -> Tensor:
    """`attend_eager` for many tokens in one launch after ``rope``, for few in two without it. It reads no hidden slot.

    Raises:
        ValueError: shapes, dtypes or layouts do not match, or the tokens do not fit into the slots.
    """
    queries = empty_queries(qkv, slots)
    num_tokens, num_heads = check_rope(qkv, rotation, queries, slots)
    batch_size, num_kv_heads, num_slots, head_dim = slots.keys.shape
    width = slots.first + num_tokens - seen.first
    num_blocks = -(-_num_stored(width, num_tokens) // _BLOCK_SLOTS)
    check_tensor("bias", seen.bias, (batch_size, 1, 1, width), qkv.dtype)
    check_tensor("blocks", seen.blocks, (batch_size, 1 + num_blocks), torch.int32)
    rotates = num_tokens <= MOST_ROTATED
    if not rotates:
        rope(qkv, rotation, queries, slots)
    num_rows = queries.shape[2]
    block = 16 if rotates else 64
    num_programs = batch_size * num_kv_heads * -(-num_rows // block)
    splits = min(_MOST_SPLITS, block_size(-(-_PROGRAMS // num_programs)), block_size(max(1, num_blocks)))
    splits = splits if rotates else 1
    out = qkv.new_empty(len(qkv), num_heads * head_dim)
    parts = out if splits == 1 else qkv.new_empty(splits, *out.shape, dtype=torch.float32)
    weights = qkv.new_empty(splits, len(qkv) * num_heads, dtype=torch.float32)
    _attend[(batch_size * num_kv_heads, splits, -(-num_rows // block))](
        qkv,
        rotation.cos,
        rotation.sin,
        queries,
        slots.keys,
        slots.values,
        seen.bias,
        seen.blocks,
        parts,
        weights,
        num_tokens,
        num_slots,
        seen.first,
        slots.first,
        width,
        num_blocks,
        Q_HEADS=num_heads,
        KV_HEADS=num_kv_heads,
        PAIRS=head_dim // 2,
        PAIR_BLOCK=max(16, block_size(head_dim // 2)),
        OWN_BLOCK=16,  # more would not fit into registers
        BLOCK_ROWS=block,
        BLOCK_SLOTS=_BLOCK_SLOTS,
        SPLITS=splits,
        ROTATES=rotates,
        LOG2_SCALE=head_dim**-0.5 * _LOG2_E,
        PRECISION="ieee" if qkv.dtype == torch.float32 else "tf32",
        num_warps=4 if rotates else 8,
        num_stages=2,
    )
    if splits > 1:
        num_all = weights.shape[1]
        _join[(num_all,)](
            parts, weights, out, num_all, WIDTH=head_dim, BLOCK=block_size(head_dim), SPLITS=splits, num_warps=4
        )
    return out


@kernel
def _attend(
    qkv_ptr: tl.tensor,
    cos_ptr: tl.tensor,
    sin_ptr: tl.tensor,
    q_ptr: tl.tensor,
    k_ptr: tl.tensor,
    v_ptr: tl.tensor,
    bias_ptr: tl.tensor,
    blocks_ptr: tl.tensor,
    parts_ptr: tl.tensor,
    weights_ptr: tl.tensor,
    num_tokens: tl.tensor,
    num_slots: tl.tensor,
    first_slot: tl.tensor,
    own_slot: tl.tensor,
    width: tl.tensor,
    num_blocks: tl.tensor,
    Q_HEADS: tl.constexpr,
    KV_HEADS: tl.constexpr,
    PAIRS: tl.constexpr,
    PAIR_BLOCK: tl.constexpr,
    OWN_BLOCK: tl.constexpr,
    BLOCK_ROWS: tl.constexpr,
    BLOCK_SLOTS: tl.constexpr,
    SPLITS: tl.constexpr,
    ROTATES: tl.constexpr,
    LOG2_SCALE: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    """One share of the slots. A head's two halves stay apart, as rotation pairs them: the scores are two products."""
    GROUP: tl.constexpr = Q_HEADS // KV_HEADS
    SIZE: tl.constexpr = 2 * PAIRS
    sample, kv_head = (tl.program_id(0) // KV_HEADS).to(tl.int64), tl.program_id(0) % KV_HEADS
    split = tl.program_id(1)
    r = tl.program_id(2) * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    token, head = r // GROUP, kv_head * GROUP + r % GROUP
    is_row = token < num_tokens
    pair = tl.arange(0, PAIR_BLOCK)
    is_pair = pair < PAIRS
    is_query = is_row[:, None] & is_pair[None, :]
    row = sample * num_tokens + token
    dtype = k_ptr.dtype.element_ty
    if ROTATES:
        q_at = qkv_ptr + ((row * (Q_HEADS + 2 * KV_HEADS) + head) * SIZE)[:, None] + pair[None, :]
        turn_at = (row * PAIRS)[:, None] + pair[None, :]
        x1 = tl.load(q_at, mask=is_query, other=0.0).to(tl.float32)
        x2 = tl.load(q_at + PAIRS, mask=is_query, other=0.0).to(tl.float32)
        cos = tl.load(cos_ptr + turn_at, mask=is_query, other=0.0)
        sin = tl.load(sin_ptr + turn_at, mask=is_query, other=0.0)
        q1, q2 = (x1 * cos - x2 * sin).to(dtype), (x2 * cos + x1 * sin).to(dtype)
    else:
        q_at = q_ptr + (((sample * KV_HEADS + kv_head) * num_tokens * GROUP + r) * SIZE)[:, None] + pair[None, :]
        q1 = tl.load(q_at, mask=is_query, other=0.0)
        q2 = tl.load(q_at + PAIRS, mask=is_query, other=0.0)
    highest = tl.full([BLOCK_ROWS], -1e30, tl.float32)
    total = tl.zeros([BLOCK_ROWS], tl.float32)
    seen1 = tl.zeros([BLOCK_ROWS, PAIR_BLOCK], tl.float32)
    seen2 = tl.zeros([BLOCK_ROWS, PAIR_BLOCK], tl.float32)

    slot_at = (sample * KV_HEADS + kv_head) * num_slots
    num_stored = own_slot - first_slot if ROTATES else width
    num_seen = tl.load(blocks_ptr + sample * (1 + num_blocks))
    for index in range(split, num_seen, SPLITS):
        block = tl.load(blocks_ptr + sample * (1 + num_blocks) + 1 + index)
        s = block * BLOCK_SLOTS + tl.arange(0, BLOCK_SLOTS)
        bias = tl.load(bias_ptr + sample * width + s, mask=s < num_stored, other=-1.0).to(tl.float32)
        is_seen = bias == 0.0
        at = (slot_at + first_slot + s) * SIZE
        k_at, is_key = at[None, :] + pair[:, None], is_seen[None, :] & is_pair[:, None]
        v_at, is_value = at[:, None] + pair[None, :], is_seen[:, None] & is_pair[None, :]
        k1 = tl.load(k_ptr + k_at, mask=is_key, other=0.0)
        k2 = tl.load(k_ptr + k_at + PAIRS, mask=is_key, other=0.0)
        v1 = tl.load(v_ptr + v_at, mask=is_value, other=0.0)
        v2 = tl.load(v_ptr + v_at + PAIRS, mask=is_value, other=0.0)
        highest, total, seen1, seen2 = _mixed(
            q1, q2, k1, k2, v1, v2, is_seen, highest, total, seen1, seen2, LOG2_SCALE, PRECISION
        )
    # The last share has the tokens' own keys too.
    for start in range(0, num_tokens if ROTATES and split == SPLITS - 1 else 0, OWN_BLOCK):
        t = start + tl.arange(0, OWN_BLOCK)
        is_own = t < num_tokens
        own_row = sample * num_tokens + t
        own_bias = tl.load(bias_ptr + sample * width + num_stored + t, mask=is_own, other=-1.0).to(tl.float32)
        heads_at = own_row * (Q_HEADS + 2 * KV_HEADS) + Q_HEADS + kv_head
        is_own_key, is_own_value = is_own[None, :] & is_pair[:, None], is_own[:, None] & is_pair[None, :]
        own_k_at = qkv_ptr + (heads_at * SIZE)[None, :] + pair[:, None]
        own_turn_at = (own_row * PAIRS)[None, :] + pair[:, None]
        own_x1 = tl.load(own_k_at, mask=is_own_key, other=0.0).to(tl.float32)
        own_x2 = tl.load(own_k_at + PAIRS, mask=is_own_key, other=0.0).to(tl.float32)
        own_cos = tl.load(cos_ptr + own_turn_at, mask=is_own_key, other=0.0)
        own_sin = tl.load(sin_ptr + own_turn_at, mask=is_own_key, other=0.0)
        own_k1, own_k2 = (
            (own_x1 * own_cos - own_x2 * own_sin).to(dtype),
            (own_x2 * own_cos + own_x1 * own_sin).to(dtype),
        )
        own_v_at = qkv_ptr + ((heads_at + KV_HEADS) * SIZE)[:, None] + pair[None, :]
        own_v1 = tl.load(own_v_at, mask=is_own_value, other=0.0)
        own_v2 = tl.load(own_v_at + PAIRS, mask=is_own_value, other=0.0)
        highest, total, seen1, seen2 = _mixed(
            q1,
            q2,
            own_k1,
            own_k2,
            own_v1,
            own_v2,
            is_own & (own_bias == 0.0),
            highest,
            total,
            seen1,
            seen2,
            LOG2_SCALE,
            PRECISION,
        )
        if tl.program_id(2) == 0:
            own_at = (slot_at + own_slot + t) * SIZE
            tl.store(k_ptr + own_at[None, :] + pair[:, None], own_k1, mask=is_own_key)
            tl.store(k_ptr + own_at[None, :] + pair[:, None] + PAIRS, own_k2, mask=is_own_key)
            tl.store(v_ptr + own_at[:, None] + pair[None, :], own_v1, mask=is_own_value)
            tl.store(v_ptr + own_at[:, None] + pair[None, :] + PAIRS, own_v2, mask=is_own_value)

    scale = 1.0 / tl.maximum(total, 1e-30)[:, None]
    num_rows = (tl.num_programs(0) // KV_HEADS).to(tl.int64) * num_tokens * Q_HEADS
    out_row = row * Q_HEADS + head
    out_at = parts_ptr + ((split * num_rows + out_row) * SIZE)[:, None] + pair[None, :]
    tl.store(out_at, (seen1 * scale).to(parts_ptr.dtype.element_ty), mask=is_query)
    tl.store(out_at + PAIRS, (seen2 * scale).to(parts_ptr.dtype.element_ty), mask=is_query)
    if SPLITS > 1:
        # The base-2 logarithm of the share's sum; a share in which nothing is seen has no weight.
        weight = tl.where(total > 0.0, highest + tl.log2(tl.maximum(total, 1e-30)), -1e30)
        tl.store(weights_ptr + split * num_rows + out_row, weight, mask=is_row)


@kernel
def _mixed(
    q1: tl.tensor,
    q2: tl.tensor,
    k1: tl.tensor,
    k2: tl.tensor,
    v1: tl.tensor,
    v2: tl.tensor,
    is_seen: tl.tensor,
    highest: tl.tensor,
    total: tl.tensor,
    seen1: tl.tensor,
    seen2: tl.tensor,
    LOG2_SCALE: tl.constexpr,
    PRECISION: tl.constexpr,
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:
    """The running softmax, one block of slots further."""
    scores = tl.dot(q2, k2, tl.dot(q1, k1, input_precision=PRECISION), input_precision=PRECISION) * LOG2_SCALE
    scores = tl.where(is_seen[None, :], scores, -1e30)
    higher = tl.maximum(highest, tl.max(scores, axis=1))
    exponentials = tl.where(is_seen[None, :], tl.exp2(scores - higher[:, None]), 0.0)
    kept = tl.exp2(highest - higher)
    total = total * kept + tl.sum(exponentials, axis=1)
    weights = exponentials.to(v1.dtype)
    seen1 = tl.dot(weights, v1, seen1 * kept[:, None], input_precision=PRECISION)
    seen2 = tl.dot(weights, v2, seen2 * kept[:, None], input_precision=PRECISION)
    return higher, total, seen1, seen2


@kernel
def _join(
    parts_ptr: tl.tensor,
    weights_ptr: tl.tensor,
    out_ptr: tl.tensor,
    num_rows: tl.tensor,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    SPLITS: tl.constexpr,
) -> None:
    row = tl.program_id(0).to(tl.int64)
    s, d = tl.arange(0, SPLITS), tl.arange(0, BLOCK)
    at = s * num_rows + row
    weights = tl.load(weights_ptr + at)
    weights = tl.exp2(weights - tl.max(weights, axis=0))
    parts = tl.load(parts_ptr + at[:, None] * WIDTH + d[None, :], mask=(d < WIDTH)[None, :], other=0.0)
    seen = tl.sum(parts * weights[:, None], axis=0) / tl.sum(weights, axis=0)
    tl.store(out_ptr + row * WIDTH + d, seen.to(out_ptr.dtype.element_ty), mask=d < WIDTH)
