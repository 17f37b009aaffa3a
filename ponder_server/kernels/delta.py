"""The recurrence of Gated DeltaNet with its gates, over a slot's state where it lies.

The kernel goes token by token, which is the faster way for a few (a fire, a verified draft); the twin goes chunk by
chunk, which is for many.

# B rows, T tokens of a row with its padding, C channels of [q | k | v], K key heads of size D, V value heads of size E
# N slots
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl
from dual_system.models.ponder.delta_rule import gated_delta_keeping
from ponder_server.kernels.conv_silu import check_second
from ponder_server.slots import Keep

_BLOCK_E = 8


def delta_eager(
    mixed_BTC: Tensor,
    speed_beta_BT2V: Tensor,
    a_log_V: Tensor,
    dt_bias_V: Tensor,
    state_NVDE: Tensor,
    slot_B: Tensor,
    num_new_B: Tensor,
    keep: Keep,
) -> Tensor:
    """Advances every row's state by its valid tokens; what it reads, (B, T, V, E), is garbage for padding.

    ``speed_beta_BT2V`` are the projections [a | b]; the state is float32 whatever the network's dtype. ``keep``: a row
    that keeps a second state leaves it as it is after so many tokens.
    """
    length = mixed_BTC.shape[1]
    key_dim, value_dim = state_NVDE.shape[2:]
    queries, keys, values = mixed_BTC.split(_sizes(mixed_BTC, state_NVDE), dim=-1)
    speed_BTV, beta_BTV = speed_beta_BT2V.chunk(2, dim=-1)
    decay_BTV = -a_log_V.float().exp() * F.softplus(speed_BTV.float() + dt_bias_V)
    # With beta 0 and decay exp(0), padding leaves the state unchanged to the last bit.
    is_valid_BT1 = (torch.arange(length, device=mixed_BTC.device) < num_new_B[:, None])[..., None]
    read, state, kept = gated_delta_keeping(
        queries.unflatten(-1, (-1, key_dim)),
        keys.unflatten(-1, (-1, key_dim)),
        values.unflatten(-1, (-1, value_dim)),
        g=decay_BTV * is_valid_BT1,
        beta=beta_BTV.sigmoid() * is_valid_BT1,
        initial_state=state_NVDE[slot_B],
        num_kept_B=keep.num_B,
    )
    state_NVDE[slot_B] = state
    keep.put(slot_B, kept)
    return read


def delta_fused(
    mixed_BTC: Tensor,
    speed_beta_BT2V: Tensor,
    a_log_V: Tensor,
    dt_bias_V: Tensor,
    state_NVDE: Tensor,
    slot_B: Tensor,
    num_new_B: Tensor,
    keep: Keep,
) -> Tensor:
    """`delta_eager` in one launch; padding reads zeros. The rows' slots must differ.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, length, num_channels = mixed_BTC.shape
    num_heads, key_dim, value_dim = state_NVDE.shape[1:]
    key_size, _, _ = _sizes(mixed_BTC, state_NVDE)
    check_tensor("mixed", mixed_BTC, (num_rows, length, num_channels), mixed_BTC.dtype)
    check_tensor("speed_beta", speed_beta_BT2V, (num_rows, length, 2 * num_heads), mixed_BTC.dtype)
    check_tensor("state of a slot", state_NVDE[0], (num_heads, key_dim, value_dim), torch.float32)
    check_second("state", state_NVDE, keep)
    read_BTVE = mixed_BTC.new_empty(num_rows, length, num_heads, value_dim)
    block = min(_BLOCK_E, value_dim)
    _delta[(num_rows, num_heads, value_dim // block)](
        mixed_BTC,
        speed_beta_BT2V,
        a_log_V,
        dt_bias_V,
        state_NVDE,
        keep.memory,
        slot_B,
        num_new_B,
        keep.num_B,
        read_BTVE,
        length,
        state_NVDE.stride(0),
        KEY_HEADS=key_size // key_dim,
        HEADS=num_heads,
        KEY_DIM=key_dim,
        VALUE_DIM=value_dim,
        BLOCK=block,
        SCALE=key_dim**-0.5,
        num_warps=1,
    )
    return read_BTVE


def _sizes(mixed_BTC: Tensor, state_NVDE: Tensor) -> tuple[int, int, int]:
    """Channels of queries, keys and values."""
    value_size = state_NVDE.shape[1] * state_NVDE.shape[3]
    key_size = (mixed_BTC.shape[2] - value_size) // 2
    return key_size, key_size, value_size


@kernel
def _delta(
    mixed_ptr: tl.tensor,
    speed_beta_ptr: tl.tensor,
    a_log_ptr: tl.tensor,
    dt_bias_ptr: tl.tensor,
    state_ptr: tl.tensor,
    kept_ptr: tl.tensor,
    slot_ptr: tl.tensor,
    num_new_ptr: tl.tensor,
    num_kept_ptr: tl.tensor,
    read_ptr: tl.tensor,
    length: tl.tensor,
    slot_stride: tl.tensor,
    KEY_HEADS: tl.constexpr,
    HEADS: tl.constexpr,
    KEY_DIM: tl.constexpr,
    VALUE_DIM: tl.constexpr,
    BLOCK: tl.constexpr,
    SCALE: tl.constexpr,
) -> None:
    """S <- exp(g) S + beta k (v - k S), read by q; a program keeps (KEY_DIM, BLOCK) of one head's state."""
    row, head = tl.program_id(0).to(tl.int64), tl.program_id(1)
    e = tl.program_id(2) * BLOCK + tl.arange(0, BLOCK)
    d = tl.arange(0, KEY_DIM)
    key_head = head // (HEADS // KEY_HEADS)
    num_new = tl.load(num_new_ptr + row).to(tl.int32)
    slot = tl.load(slot_ptr + row).to(tl.int64)
    num_kept = tl.load(num_kept_ptr + row).to(tl.int32)
    in_slots = slot * slot_stride + (head * KEY_DIM + d[:, None]) * VALUE_DIM + e[None, :]
    state = tl.load(state_ptr + in_slots)
    speed_of_head = -tl.exp(tl.load(a_log_ptr + head).to(tl.float32))
    bias = tl.load(dt_bias_ptr + head).to(tl.float32)
    CHANNELS: tl.constexpr = 2 * KEY_HEADS * KEY_DIM + HEADS * VALUE_DIM
    q_ptr = mixed_ptr + row * length * CHANNELS + key_head * KEY_DIM + d
    k_ptr = q_ptr + KEY_HEADS * KEY_DIM
    v_ptr = mixed_ptr + row * length * CHANNELS + 2 * KEY_HEADS * KEY_DIM + head * VALUE_DIM + e
    speed_ptr = speed_beta_ptr + row * length * 2 * HEADS + head
    # A token's numbers are on their way while the one before is summed: few programs wait for memory, one by one.
    next_q, next_k, next_v = tl.load(q_ptr), tl.load(k_ptr), tl.load(v_ptr)
    next_speed, next_beta = tl.load(speed_ptr), tl.load(speed_ptr + HEADS)
    for token in range(num_new):
        at = row * length + token
        q, k, v = next_q.to(tl.float32), next_k.to(tl.float32), next_v.to(tl.float32)
        speed, beta = next_speed.to(tl.float32) + bias, tl.sigmoid(next_beta.to(tl.float32))
        following = tl.minimum(token + 1, num_new - 1)
        next_q, next_k = tl.load(q_ptr + following * CHANNELS), tl.load(k_ptr + following * CHANNELS)
        next_v = tl.load(v_ptr + following * CHANNELS)
        next_speed = tl.load(speed_ptr + following * 2 * HEADS)
        next_beta = tl.load(speed_ptr + following * 2 * HEADS + HEADS)
        q = q * (tl.rsqrt(tl.sum(q * q, axis=0) + 1e-6) * SCALE)
        k = k * tl.rsqrt(tl.sum(k * k, axis=0) + 1e-6)
        softplus = tl.where(speed > 20.0, speed, tl.log(1.0 + tl.exp(tl.minimum(speed, 20.0))))
        beta = beta.to(read_ptr.dtype.element_ty).to(tl.float32)  # as torch rounds it
        state = state * tl.exp(speed_of_head * softplus)
        written = (v - tl.sum(state * k[:, None], axis=0)) * beta
        state += k[:, None] * written[None, :]
        read = tl.sum(state * q[:, None], axis=0)
        tl.store(read_ptr + (at * HEADS + head) * VALUE_DIM + e, read.to(read_ptr.dtype.element_ty))
        if token + 1 == num_kept:
            tl.store(kept_ptr + in_slots, state)
    tl.store(state_ptr + in_slots, state)
    nothing = tl.zeros([BLOCK], read_ptr.dtype.element_ty)
    for token in range(num_new, length):
        tl.store(read_ptr + ((row * length + token) * HEADS + head) * VALUE_DIM + e, nothing)
