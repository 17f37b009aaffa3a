"""The causal convolution of Gated DeltaNet with its SiLU, over a slot's state where it lies.

# B rows, T tokens of a row with its padding, C channels, W width of the convolution, N slots
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl
from ponder_server.slots import Keep

_BLOCK_T, _BLOCK_C = 16, 128


def conv_silu_eager(
    x_BTC: Tensor, weight_CW: Tensor, state_NCW: Tensor, slot_B: Tensor, num_new_B: Tensor, keep: Keep
) -> Tensor:
    """Convolves [state | new] of every row, (B, T, C); the state becomes the last W valid inputs.

    ``keep``: a row that keeps a second state leaves the W inputs before there.
    """
    num_channels, width = weight_CW.shape
    inputs_BCT = torch.cat([state_NCW[slot_B], x_BTC.transpose(1, 2)], dim=-1)

    def last(num_B: Tensor) -> Tensor:
        """The W inputs that end at a token: the last valid one, not the padding."""
        place_BW = num_B[:, None] + torch.arange(width, device=x_BTC.device)
        return inputs_BCT.gather(2, place_BW[:, None].expand(-1, num_channels, -1))

    state_NCW[slot_B] = last(num_new_B)
    keep.put(slot_B, last(keep.num_B))
    mixed_BCT = F.conv1d(inputs_BCT[..., 1:], weight_CW[:, None], groups=num_channels)
    return F.silu(mixed_BCT).transpose(1, 2)


def conv_silu_fused(
    x_BTC: Tensor, weight_CW: Tensor, state_NCW: Tensor, slot_B: Tensor, num_new_B: Tensor, keep: Keep
) -> Tensor:
    """`conv_silu_eager` in one launch. The rows' slots must differ.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, length, num_channels = x_BTC.shape
    width = weight_CW.shape[1]
    check_tensor("x", x_BTC, (num_rows, length, num_channels), x_BTC.dtype)
    check_tensor("weight", weight_CW, (num_channels, width), x_BTC.dtype)
    check_tensor("state of a slot", state_NCW[0], (num_channels, width), x_BTC.dtype)
    check_second("state", state_NCW, keep)
    out_BTC = torch.empty_like(x_BTC)
    grid = (num_rows, -(-length // _BLOCK_T), -(-num_channels // _BLOCK_C))
    _conv_silu[grid](
        x_BTC,
        weight_CW,
        state_NCW,
        keep.memory,
        slot_B,
        num_new_B,
        keep.num_B,
        out_BTC,
        length,
        state_NCW.stride(0),
        CHANNELS=num_channels,
        WIDTH=width,
        BLOCK_T=_BLOCK_T,
        BLOCK_C=_BLOCK_C,
    )
    return out_BTC


def check_second(name: str, state: Tensor, keep: Keep) -> None:
    """Raises ValueError unless the second state lies as the first does: kernels go to both by the same strides."""
    first, second = ((tuple(x.shape), x.stride(), x.dtype) for x in (state, keep.memory))
    if first != second:
        raise ValueError(f"second {name}: expected shape, strides and dtype of the first, {first}, came {second}")


@kernel
def _conv_silu(
    x_ptr: tl.tensor,
    weight_ptr: tl.tensor,
    state_ptr: tl.tensor,
    kept_ptr: tl.tensor,
    slot_ptr: tl.tensor,
    num_new_ptr: tl.tensor,
    num_kept_ptr: tl.tensor,
    out_ptr: tl.tensor,
    length: tl.tensor,
    slot_stride: tl.tensor,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK_T: tl.constexpr,
    BLOCK_C: tl.constexpr,
) -> None:
    """Only the first block of tokens reaches back into the state, and it alone writes it: BLOCK_T >= WIDTH."""
    row, block = tl.program_id(0).to(tl.int64), tl.program_id(1)
    channel = tl.program_id(2) * BLOCK_C + tl.arange(0, BLOCK_C)
    is_channel = channel < CHANNELS
    token = block * BLOCK_T + tl.arange(0, BLOCK_T)
    x_at = x_ptr + row * length * CHANNELS + channel
    in_slots = tl.load(slot_ptr + row).to(tl.int64) * slot_stride + channel * WIDTH
    state_at = state_ptr + in_slots
    total = tl.zeros([BLOCK_T, BLOCK_C], tl.float32)
    for tap in tl.static_range(WIDTH):
        source = token - (WIDTH - 1 - tap)
        is_new = (source >= 0) & (source < length)
        x = tl.load(x_at[None, :] + source[:, None] * CHANNELS, mask=is_new[:, None] & is_channel[None, :], other=0.0)
        if block == 0:
            is_old = (source < 0)[:, None] & is_channel[None, :]
            old = tl.load(state_at[None, :] + (WIDTH + source)[:, None], mask=is_old, other=0.0)
            x = tl.where((source < 0)[:, None], old, x)
        weight = tl.load(weight_ptr + channel * WIDTH + tap, mask=is_channel, other=0.0)
        total += x.to(tl.float32) * weight.to(tl.float32)[None, :]
    total = total.to(out_ptr.dtype.element_ty).to(tl.float32)  # torch rounds between convolution and SiLU
    out = (total * tl.sigmoid(total)).to(out_ptr.dtype.element_ty)
    out_at = out_ptr + row * length * CHANNELS + channel
    is_inside = (token < length)[:, None] & is_channel[None, :]
    tl.store(out_at[None, :] + token[:, None] * CHANNELS, out, mask=is_inside)
    if block == 0:
        place = tl.arange(0, WIDTH)
        num_kept = tl.load(num_kept_ptr + row).to(tl.int32)
        last = _last(tl.load(num_new_ptr + row).to(tl.int32), x_at, state_at, is_channel, CHANNELS, WIDTH)
        kept = _last(num_kept, x_at, state_at, is_channel, CHANNELS, WIDTH)
        tl.debug_barrier()  # every thread has read the old state
        tl.store(state_at[:, None] + place[None, :], last, mask=is_channel[:, None])
        kept_at = (kept_ptr + in_slots)[:, None] + place[None, :]
        tl.store(kept_at, kept, mask=is_channel[:, None] & (num_kept > 0))


@kernel
def _last(
    count: tl.tensor,
    x_at: tl.tensor,
    state_at: tl.tensor,
    is_channel: tl.tensor,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
) -> tl.tensor:
    """The last WIDTH inputs of [state | first ``count`` new tokens]."""
    token = count - WIDTH + tl.arange(0, WIDTH)
    is_old = (token < 0)[None, :]
    old = tl.load(state_at[:, None] + (WIDTH + token)[None, :], mask=is_old & is_channel[:, None], other=0.0)
    new_at = x_at[:, None] + token[None, :] * CHANNELS
    return tl.where(is_old, old, tl.load(new_at, mask=(token >= 0)[None, :] & is_channel[:, None], other=0.0))
