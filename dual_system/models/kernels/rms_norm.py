"""RMSNorm and LayerNorm, plain or styled by time (adaRMS, adaLN), together with the gated residual that precedes them.

Between two GEMMs of a stream comes x <- x + gate * branch, then norm(x): six passes over memory as eager operations,
one here. The norm may also be given in fp8, for products with fp8 weights.
"""

# R rows (batch times tokens), E width

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dual_system.models.kernels.fp8 import NARROW, Quantised, quantise_eager, store_quantised
from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl

TOLERANCE = {
    torch.float32: Tolerance(rtol=1e-5, atol=1e-6),
    # Twin: gate, product and sum are each rounded; kernel: the sum only. Each rounding is half of 2**-7.
    torch.bfloat16: Tolerance(rtol=2**-7, atol=2**-6),
}


@dataclass(frozen=True, slots=True, eq=False)
class Style:
    """Scale and shift of a norm, (E,) float32 each; without ``shift`` the norm is plain."""

    scale: Tensor
    """1 + w of a plain norm, 1 + scale of a styled one."""
    shift: Tensor | None = None
    eps: float = 1e-6  # Gemma's and Qwen's
    is_centred: bool = False
    """LayerNorm: the mean is subtracted first."""


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """The residual that is added to the stream before the norm."""

    branch: Tensor
    """(R, E), in the stream's dtype"""
    gate: Tensor | None = None
    """(E,) float32; None adds the branch ungated."""


def norm_eager(
    x_RE: Tensor, out_RE: Tensor, style: Style, residual: Residual | None = None, narrow: Quantised | None = None
) -> None:
    """Adds ``residual`` to ``x_RE`` in place and writes the norm of the sum to ``out_RE``, as the models do.

    ``narrow``: where to write the norm, as stored, in fp8 too.
    """
    if residual is not None:
        gated_RE = residual.branch if residual.gate is None else residual.gate.to(x_RE.dtype) * residual.branch
        x_RE += gated_RE
    if style.is_centred:
        normed_RE = torch.nn.functional.layer_norm(x_RE.float(), x_RE.shape[-1:], eps=style.eps) * style.scale
    else:
        normed_RE = torch.nn.functional.rms_norm(x_RE.float(), x_RE.shape[-1:], None, style.eps) * style.scale
    out_RE.copy_(normed_RE if style.shift is None else normed_RE + style.shift)
    if narrow is not None:
        for place, rows in zip(narrow, quantise_eager(out_RE), strict=True):
            place.copy_(rows)


def norm_fused(
    x_RE: Tensor, out_RE: Tensor, style: Style, residual: Residual | None = None, narrow: Quantised | None = None
) -> None:
    """`norm_eager` in one launch, one program per row. It sums in float32, and normalises the sum as stored.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    num_rows, width = x_RE.shape
    check_tensor("x", x_RE, (num_rows, width), x_RE.dtype)
    check_tensor("out", out_RE, (num_rows, width), x_RE.dtype)
    check_tensor("scale", style.scale, (width,), torch.float32)
    if style.shift is not None:
        check_tensor("shift", style.shift, (width,), torch.float32)
    if residual is not None:
        check_tensor("branch", residual.branch, (num_rows, width), x_RE.dtype)
        if residual.gate is not None:
            check_tensor("gate", residual.gate, (width,), torch.float32)
    if narrow is not None:
        check_tensor("narrow", narrow.narrow_MI, (num_rows, width), NARROW)
        check_tensor("narrow scale", narrow.scale_M, (num_rows,), torch.float32)
    has_gate = residual is not None and residual.gate is not None
    _norm[(num_rows,)](
        x_RE,
        x_RE if residual is None else residual.branch,
        residual.gate if residual is not None and has_gate else style.scale,
        style.scale,
        style.scale if style.shift is None else style.shift,
        out_RE,
        out_RE if narrow is None else narrow.narrow_MI,
        style.scale if narrow is None else narrow.scale_M,
        WIDTH=width,
        BLOCK=block_size(width),
        EPS=style.eps,
        IS_CENTRED=style.is_centred,
        HAS_BRANCH=residual is not None,
        HAS_GATE=has_gate,
        HAS_SHIFT=style.shift is not None,
        HAS_NARROW=narrow is not None,
    )


@kernel
def _norm(
    x_ptr: tl.tensor,
    branch_ptr: tl.tensor,
    gate_ptr: tl.tensor,
    scale_ptr: tl.tensor,
    shift_ptr: tl.tensor,
    out_ptr: tl.tensor,
    narrow_ptr: tl.tensor,
    narrow_scale_ptr: tl.tensor,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    EPS: tl.constexpr,
    IS_CENTRED: tl.constexpr,
    HAS_BRANCH: tl.constexpr,
    HAS_GATE: tl.constexpr,
    HAS_SHIFT: tl.constexpr,
    HAS_NARROW: tl.constexpr,
) -> None:
    column = tl.arange(0, BLOCK)
    is_inside = column < WIDTH
    row = tl.program_id(0).to(tl.int64)
    at = row * WIDTH + column
    x = tl.load(x_ptr + at, mask=is_inside, other=0.0).to(tl.float32)
    if HAS_BRANCH:
        branch = tl.load(branch_ptr + at, mask=is_inside, other=0.0).to(tl.float32)
        if HAS_GATE:
            branch = branch * tl.load(gate_ptr + column, mask=is_inside, other=0.0)
        stored = (x + branch).to(x_ptr.dtype.element_ty)
        tl.store(x_ptr + at, stored, mask=is_inside)
        x = stored.to(tl.float32)
    if IS_CENTRED:
        x = tl.where(is_inside, x - tl.sum(x, axis=0) / WIDTH, 0.0)
    y = x * tl.rsqrt(tl.sum(x * x, axis=0) / WIDTH + EPS)
    y = y * tl.load(scale_ptr + column, mask=is_inside, other=0.0)
    if HAS_SHIFT:
        y = y + tl.load(shift_ptr + column, mask=is_inside, other=0.0)
    normed = y.to(out_ptr.dtype.element_ty)
    tl.store(out_ptr + at, normed, mask=is_inside)
    if HAS_NARROW:
        store_quantised(normed.to(tl.float32), row, column, narrow_ptr, narrow_scale_ptr, WIDTH)
