"""The gates of MLPs over the one GEMM that makes both halves: Gemma's gelu_tanh(gate) * up, Qwen's SiLU(gate) * up."""

# R rows, M MLP width; 2M columns are [gate | up]

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=1e-6),
    # Twin: the gate and the product are rounded; kernel: the product only.
    torch.bfloat16: Tolerance(rtol=2**-6, atol=2**-9),
}
MAX_BLOCK = 1024

Gate: TypeAlias = Callable[[Tensor, Tensor], None]


def geglu_eager(gate_up_R2M: Tensor, out_RM: Tensor) -> None:
    """Writes gelu_tanh(gate) * up to ``out_RM``, with the models' arithmetic."""
    gate_RM, up_RM = gate_up_R2M.chunk(2, dim=-1)
    torch.mul(F.gelu(gate_RM, approximate="tanh"), up_RM, out=out_RM)


def swiglu_eager(gate_up_R2M: Tensor, out_RM: Tensor) -> None:
    """Writes SiLU(gate) * up to ``out_RM``, with the models' arithmetic."""
    gate_RM, up_RM = gate_up_R2M.chunk(2, dim=-1)
    torch.mul(F.silu(gate_RM), up_RM, out=out_RM)


def geglu_fused(gate_up_R2M: Tensor, out_RM: Tensor) -> None:
    """`geglu_eager` in one launch, in float32 between load and store.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    _launch(gate_up_R2M, out_RM, is_silu=False)


def swiglu_fused(gate_up_R2M: Tensor, out_RM: Tensor) -> None:
    """`swiglu_eager` in one launch, in float32 between load and store.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    _launch(gate_up_R2M, out_RM, is_silu=True)


def _launch(gate_up_R2M: Tensor, out_RM: Tensor, *, is_silu: bool) -> None:
    num_rows, width = out_RM.shape
    check_tensor("out", out_RM, (num_rows, width), out_RM.dtype)
    check_tensor("gate_up", gate_up_R2M, (num_rows, 2 * width), out_RM.dtype)
    block = min(block_size(width), MAX_BLOCK)
    _gate[(num_rows, -(-width // block))](gate_up_R2M, out_RM, WIDTH=width, BLOCK=block, IS_SILU=is_silu)


@kernel
def _gate(
    gate_up_ptr: tl.tensor, out_ptr: tl.tensor, WIDTH: tl.constexpr, BLOCK: tl.constexpr, IS_SILU: tl.constexpr
) -> None:
    row = tl.program_id(0).to(tl.int64)
    column = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    is_inside = column < WIDTH
    gate_at = gate_up_ptr + row * 2 * WIDTH + column
    gate = tl.load(gate_at, mask=is_inside, other=0.0).to(tl.float32)
    up = tl.load(gate_at + WIDTH, mask=is_inside, other=0.0).to(tl.float32)
    out_at = out_ptr + row * WIDTH + column
    tl.store(out_at, gated(gate, up, IS_SILU).to(out_ptr.dtype.element_ty), mask=is_inside)


@kernel
def gated(gate: tl.tensor, up: tl.tensor, IS_SILU: tl.constexpr) -> tl.tensor:
    """The gate times ``up`` in float32, for kernels."""
    # gelu_tanh(x) is x times a sigmoid as SiLU(x) is: (1 + tanh(u)) / 2 is the sigmoid of 2u, u = sqrt(2 / pi) (...).
    if IS_SILU:
        x = gate
    else:
        x = 1.5957691216057308 * (gate + 0.044715 * gate * gate * gate)
    decay = tl.exp(-tl.abs(x))  # cannot overflow
    return gate * (tl.where(x >= 0, 1.0, decay) / (1.0 + decay)) * up
