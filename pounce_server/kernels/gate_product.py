"""The product that makes [gate | up], with the gate of an MLP as its end: neither of them goes through memory."""

# R rows, E inputs, M MLP width; the weight's 2M rows are [gate | up]

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl
from pounce_server.kernels.gate import Gate, gated

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=1e-5),
    # Twin: the product's gate and up are rounded too.
    torch.bfloat16: Tolerance(rtol=2**-5, atol=2**-5),
}


class Product(Protocol):
    """Writes x W^T, plus a bias, to ``out_MN``."""

    def __call__(self, x_MK: Tensor, weight_NK: Tensor, out_MN: Tensor, bias_N: Tensor | None = None) -> None: ...


def gate_product_eager(product: Product, gate: Gate, x_RE: Tensor, weight_2ME: Tensor, out_RM: Tensor) -> None:
    """Writes the gate of (x gate^T, x up^T) to ``out_RM``, by the product and the gate that were taken."""
    gate_up_R2M = x_RE.new_empty(len(x_RE), len(weight_2ME))
    product(x_RE, weight_2ME, gate_up_R2M)
    gate(gate_up_R2M, out_RM)


def geglu_product_fused(product: Product, gate: Gate, x_RE: Tensor, weight_2ME: Tensor, out_RM: Tensor) -> None:
    """`gate_product_eager` with `geglu` in one launch, in float32 between its sums and the store.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    _launch(x_RE, weight_2ME, out_RM, is_silu=False)


def swiglu_product_fused(product: Product, gate: Gate, x_RE: Tensor, weight_2ME: Tensor, out_RM: Tensor) -> None:
    """`gate_product_eager` with `swiglu` in one launch, in float32 between its sums and the store.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    _launch(x_RE, weight_2ME, out_RM, is_silu=True)


def _launch(x_RE: Tensor, weight_2ME: Tensor, out_RM: Tensor, *, is_silu: bool) -> None:
    (num_rows, width), inputs = out_RM.shape, x_RE.shape[1]
    check_tensor("x", x_RE, (num_rows, inputs), x_RE.dtype)
    check_tensor("weight", weight_2ME, (2 * width, inputs), x_RE.dtype)
    check_tensor("out", out_RM, (num_rows, width), x_RE.dtype)
    rows = min(max(block_size(num_rows), 16), 128)
    columns = 32 if rows < 128 else 64  # few rows: more programs, each reads less of the weight
    grid = (-(-num_rows // rows), -(-width // columns))  # those that read the same weights run side by side
    _gate_product[grid](
        x_RE,
        weight_2ME,
        out_RM,
        num_rows,
        WIDTH=width,
        INPUTS=inputs,
        BLOCK_ROWS=rows,
        BLOCK_COLUMNS=columns,
        BLOCK_INPUTS=64 if rows == 128 else 128,
        IS_SILU=is_silu,
        PRECISION="ieee" if x_RE.dtype == torch.float32 else "tf32",
        num_warps=8 if rows == 128 else 4,
        num_stages=3,
    )


@kernel
def _gate_product(
    x_ptr: tl.tensor,
    weight_ptr: tl.tensor,
    out_ptr: tl.tensor,
    num_rows: tl.tensor,
    WIDTH: tl.constexpr,
    INPUTS: tl.constexpr,
    BLOCK_ROWS: tl.constexpr,
    BLOCK_COLUMNS: tl.constexpr,
    BLOCK_INPUTS: tl.constexpr,
    IS_SILU: tl.constexpr,
    PRECISION: tl.constexpr,
) -> None:
    row = tl.program_id(0).to(tl.int64) * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    column = tl.program_id(1).to(tl.int64) * BLOCK_COLUMNS + tl.arange(0, BLOCK_COLUMNS)
    gate = tl.zeros([BLOCK_ROWS, BLOCK_COLUMNS], tl.float32)
    up = tl.zeros([BLOCK_ROWS, BLOCK_COLUMNS], tl.float32)
    for start in range(0, INPUTS, BLOCK_INPUTS):
        i = start + tl.arange(0, BLOCK_INPUTS)
        is_input = i < INPUTS
        is_weight = is_input[:, None] & (column < WIDTH)[None, :]
        x_at = x_ptr + (row * INPUTS)[:, None] + i[None, :]
        x = tl.load(x_at, mask=(row < num_rows)[:, None] & is_input[None, :], other=0.0)
        gate_at = weight_ptr + (column * INPUTS)[None, :] + i[:, None]
        gate = tl.dot(x, tl.load(gate_at, mask=is_weight, other=0.0), gate, input_precision=PRECISION)
        up_at = gate_at + WIDTH * INPUTS
        up = tl.dot(x, tl.load(up_at, mask=is_weight, other=0.0), up, input_precision=PRECISION)
    out_at = out_ptr + (row * WIDTH)[:, None] + column[None, :]
    is_inside = (row < num_rows)[:, None] & (column < WIDTH)[None, :]
    tl.store(out_at, gated(gate, up, IS_SILU).to(out_ptr.dtype.element_ty), mask=is_inside)
