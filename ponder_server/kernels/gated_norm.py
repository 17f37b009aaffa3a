"""The output norm of Gated DeltaNet: RMSNorm of a head, times SiLU of its gate.

# R tokens, V heads of size E
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl


def gated_norm_eager(read_RVE: Tensor, gate_RX: Tensor, weight_E: Tensor, eps: float) -> Tensor:
    """The normed and gated heads side by side, (R, V E); the norm is rounded before it is scaled, as in training."""
    normed_RVE = F.rms_norm(read_RVE.float(), read_RVE.shape[-1:], None, eps).to(read_RVE.dtype) * weight_E
    return (normed_RVE * F.silu(gate_RX.float()).view(read_RVE.shape)).to(read_RVE.dtype).flatten(1)


def gated_norm_fused(read_RVE: Tensor, gate_RX: Tensor, weight_E: Tensor, eps: float) -> Tensor:
    """`gated_norm_eager` in one launch, a program per token and head.

    Raises:
        ValueError: shapes, dtypes or layouts do not match, or E is no power of two.
    """
    num_tokens, num_heads, size = read_RVE.shape
    check_tensor("read", read_RVE, (num_tokens, num_heads, size), read_RVE.dtype)
    check_tensor("gate", gate_RX, (num_tokens, num_heads * size), read_RVE.dtype)
    check_tensor("weight", weight_E, (size,), weight_E.dtype)
    out_RX = torch.empty_like(gate_RX)
    _gated_norm[(num_tokens, num_heads)](
        read_RVE, gate_RX, weight_E, out_RX, HEADS=num_heads, SIZE=size, EPS=eps, num_warps=1
    )
    return out_RX


@kernel
def _gated_norm(
    read_ptr: tl.tensor,
    gate_ptr: tl.tensor,
    weight_ptr: tl.tensor,
    out_ptr: tl.tensor,
    HEADS: tl.constexpr,
    SIZE: tl.constexpr,
    EPS: tl.constexpr,
) -> None:
    e = tl.arange(0, SIZE)
    at = (tl.program_id(0).to(tl.int64) * HEADS + tl.program_id(1)) * SIZE + e
    read = tl.load(read_ptr + at)
    gate = tl.load(gate_ptr + at).to(tl.float32)
    x = read.to(tl.float32)
    x = (x * tl.rsqrt(tl.sum(x * x, axis=0) / SIZE + EPS)).to(read.dtype).to(tl.float32)
    x = x * tl.load(weight_ptr + e).to(tl.float32)
    tl.store(out_ptr + at, (x * (gate * tl.sigmoid(gate))).to(read.dtype))
