"""Rows in fp8 (e4m3) for products with fp8 weights, and the product of few rows, whose weights alone are fp8.

A row's scale is its largest number / 448. Few rows are not quantised: their product takes the time of reading the
weights, a byte each, whatever it computes.
"""

# M rows, I inputs, O outputs

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import block_size, check_tensor, kernel, tl

NARROW = torch.float8_e4m3fn
MOST = 448.0
FEW_ROWS = 16
"""Most rows of `few_rows_fused`, and the height of a tensor core's tile."""
_TINY = torch.finfo(torch.float32).tiny
_BLOCK_O, _BLOCK_I = 16, 256


class Quantised(NamedTuple):
    """Rows as fp8 numbers (M, I) and the factors (M,) float32 that widen them."""

    narrow_MI: Tensor
    scale_M: Tensor

    @classmethod
    def blank(cls, like_MI: Tensor) -> Quantised:
        return cls(
            torch.empty(like_MI.shape, dtype=NARROW, device=like_MI.device),
            torch.empty(like_MI.shape[0], dtype=torch.float32, device=like_MI.device),
        )


def quantise_eager(x_MI: Tensor) -> Quantised:
    """Each row over its scale, rounded to nearest. NaN stays NaN; a row with an infinity has NaN in its place."""
    exact_MI = x_MI.float()
    scale_M = (exact_MI.abs().amax(dim=1) / MOST).clamp(min=_TINY)  # positive for a row of zeros too
    # Conversion overflows to NaN, and rounding in the division may pass the largest number.
    return Quantised((exact_MI / scale_M[:, None]).clamp(-MOST, MOST).to(NARROW), scale_M)


def quantise_fused(x_MI: Tensor) -> Quantised:
    """`quantise_eager` in one launch, a program per row.

    Raises:
        ValueError: ``x_MI`` is not contiguous.
    """
    num_rows, width = x_MI.shape
    check_tensor("x", x_MI, (num_rows, width), x_MI.dtype)
    rows = Quantised.blank(x_MI)
    _quantise[(num_rows,)](x_MI, *rows, WIDTH=width, BLOCK=block_size(width), num_warps=8)
    return rows


def few_rows_eager(x_MI: Tensor, weight_OI: Tensor, scale_O: Tensor) -> Tensor:
    """x times the widened weight's transpose, (M, O)."""
    return F.linear(x_MI, weight_OI.to(x_MI.dtype)) * scale_O.to(x_MI.dtype)


def few_rows_fused(x_MI: Tensor, weight_OI: Tensor, scale_O: Tensor) -> Tensor:
    """`few_rows_eager` in one launch, for at most `FEW_ROWS`; weights are widened in registers.

    Raises:
        ValueError: shapes, dtypes or layouts do not match, or there are more rows.
    """
    num_rows, width = x_MI.shape
    num_outputs = len(weight_OI)
    if num_rows > FEW_ROWS:
        raise ValueError(f"expected at most {FEW_ROWS} rows, came {num_rows}")
    check_tensor("x", x_MI, (num_rows, width), x_MI.dtype)
    check_tensor("weight", weight_OI, (num_outputs, width), NARROW)
    check_tensor("scale", scale_O, (num_outputs,), torch.float32)
    out_MO = x_MI.new_empty(num_rows, num_outputs)
    _few_rows[(-(-num_outputs // _BLOCK_O),)](
        x_MI,
        weight_OI,
        scale_O,
        out_MO,
        num_rows,
        INPUTS=width,
        OUTPUTS=num_outputs,
        ROWS=FEW_ROWS,
        BLOCK_O=_BLOCK_O,
        BLOCK_I=_BLOCK_I,
        PRECISION="ieee" if x_MI.dtype == torch.float32 else "tf32",
        num_stages=4,
    )
    return out_MO


@kernel
def store_quantised(
    x: tl.tensor, row: tl.tensor, column: tl.tensor, narrow_ptr: tl.tensor, scale_ptr: tl.tensor, WIDTH: tl.constexpr
) -> None:
    """Part of kernels that make a whole row: stores it in fp8. ``x`` is float32, and 0 beyond the width."""
    scale = tl.maximum(tl.max(tl.abs(x), axis=0) / 448.0, 1.1754943508222875e-38)
    narrow = tl.clamp(x / scale, -448.0, 448.0, propagate_nan=tl.PropagateNan.ALL).to(narrow_ptr.dtype.element_ty)
    tl.store(narrow_ptr + row * WIDTH + column, narrow, mask=column < WIDTH)
    tl.store(scale_ptr + row, scale)


@kernel
def _quantise(
    x_ptr: tl.tensor, narrow_ptr: tl.tensor, scale_ptr: tl.tensor, WIDTH: tl.constexpr, BLOCK: tl.constexpr
) -> None:
    row = tl.program_id(0).to(tl.int64)
    column = tl.arange(0, BLOCK)
    x = tl.load(x_ptr + row * WIDTH + column, mask=column < WIDTH, other=0.0).to(tl.float32)
    store_quantised(x, row, column, narrow_ptr, scale_ptr, WIDTH)


@kernel
def _few_rows(
    x_ptr: tl.tensor,
    weight_ptr: tl.tensor,
    scale_ptr: tl.tensor,
    out_ptr: tl.tensor,
    num_rows: tl.tensor,
    INPUTS: tl.constexpr,
    OUTPUTS: tl.constexpr,
    ROWS: tl.constexpr,
    BLOCK_O: tl.constexpr,
    BLOCK_I: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    row = tl.arange(0, ROWS)[:, None]
    o = tl.program_id(0) * BLOCK_O + tl.arange(0, BLOCK_O)
    summed = tl.zeros([ROWS, BLOCK_O], tl.float32)
    for start in range(0, INPUTS, BLOCK_I):
        i = start + tl.arange(0, BLOCK_I)[None, :]
        x = tl.load(x_ptr + row * INPUTS + i, mask=(row < num_rows) & (i < INPUTS), other=0.0)
        weight_at = weight_ptr + o.to(tl.int64)[:, None] * INPUTS + i
        weight = tl.load(weight_at, mask=(o[:, None] < OUTPUTS) & (i < INPUTS), other=0.0)
        summed += tl.dot(x, tl.trans(weight.to(x.dtype)), input_precision=PRECISION)
    scale = tl.load(scale_ptr + o, mask=o < OUTPUTS, other=0.0)
    out_at = out_ptr + row * OUTPUTS + o[None, :]
    tl.store(
        out_at, (summed * scale[None, :]).to(out_ptr.dtype.element_ty), mask=(row < num_rows) & (o < OUTPUTS)[None, :]
    )
