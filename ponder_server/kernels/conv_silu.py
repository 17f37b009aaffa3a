"""The causal convolution of Gated DeltaNet with its SiLU, over a slot's state where it lies.

# B rows, T tokens of a row with its padding, C channels, W width of the convolution, N slots
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl

_BLOCK_T, _BLOCK_C = 16, 128


def conv_silu_eager(x_BTC: Tensor, weight_CW: Tensor, state_NCW: Tensor, slot_B: Tensor, num_new_B: Tensor) -> Tensor:
    """Convolves [state | new] of every row, (B, T, C); the state becomes the last W valid inputs."""
    num_channels, width = weight_CW.shape
    inputs_BCT = torch.cat([state_NCW[slot_B], x_BTC.transpose(1, 2)], dim=-1)
    # The last W inputs of each row end at its last valid token, not at its padding.
    kept_BW = num_new_B[:, None] + torch.arange(width, device=x_BTC.device)
    state_NCW[slot_B] = inputs_BCT.gather(2, kept_BW[:, None].expand(-1, num_channels, -1))
    mixed_BCT = F.conv1d(inputs_BCT[..., 1:], weight_CW[:, None], groups=num_channels)
    return F.silu(mixed_BCT).transpose(1, 2)


def conv_silu_fused(x_BTC: Tensor, weight_CW: Tensor, state_NCW: Tensor, slot_B: Tensor, num_new_B: Tensor) -> Tensor:
    """`conv_silu_eager` in one launch. The rows' slots must differ.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, length, num_channels = x_BTC.shape
    width = weight_CW.shape[1]
    check_tensor("x", x_BTC, (num_rows, length, num_channels), x_BTC.dtype)
    check_tensor("weight", weight_CW, (num_channels, width), x_BTC.dtype)
    check_tensor("state of a slot", state_NCW[0], (num_channels, width), x_BTC.dtype)
    out_BTC = torch.empty_like(x_BTC)
    grid = (num_rows, -(-length // _BLOCK_T), -(-num_channels // _BLOCK_C))
    _conv_silu[grid](
        x_BTC,
        weight_CW,
        state_NCW,
        slot_B,
        num_new_B,
        out_BTC,
        length,
        state_NCW.stride(0),
        CHANNELS=num_channels,
        WIDTH=width,
        BLOCK_T=_BLOCK_T,
        BLOCK_C=_BLOCK_C,
    )
    return out_BTC


@kernel
def _conv_silu(
    x_ptr: tl.tensor,
    weight_ptr: tl.tensor,
    state_ptr: tl.tensor,
    slot_ptr: tl.tensor,
    num_new_ptr: tl.tensor,
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
    state_at = state_ptr + tl.load(slot_ptr + row).to(tl.int64) * slot_stride + channel * WIDTH
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
        last = tl.load(num_new_ptr + row).to(tl.int32) - WIDTH + place
        was_old = (last < 0)[None, :] & is_channel[:, None]
        kept = tl.load(state_at[:, None] + (WIDTH + last)[None, :], mask=was_old, other=0.0)
        was_new = (last >= 0)[None, :] & is_channel[:, None]
        come = tl.load(x_at[:, None] + last[None, :] * CHANNELS, mask=was_new, other=0.0)
        tl.debug_barrier()  # every thread has read the old state
        tl.store(
            state_at[:, None] + place[None, :], tl.where((last < 0)[None, :], kept, come), mask=is_channel[:, None]
        )
