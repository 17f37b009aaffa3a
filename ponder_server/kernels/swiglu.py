"""The gate of Qwen's MLP, SiLU(gate) * up."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.kernels.launch import check_tensor, kernel, tl

_BLOCK = 1024


def swiglu_eager(gate: Tensor, up: Tensor) -> Tensor:
    """SiLU(gate) * up, of any shape."""
    return F.silu(gate) * up


def swiglu_fused(gate: Tensor, up: Tensor) -> Tensor:
    """`swiglu_eager` in one launch, in float32 between load and store.

    Raises:
        ValueError: shapes, dtypes or layouts do not match.
    """
    check_tensor("gate", gate, tuple(gate.shape), gate.dtype)
    check_tensor("up", up, tuple(gate.shape), gate.dtype)
    out = torch.empty_like(gate)
    _swiglu[(-(-gate.numel() // _BLOCK),)](gate, up, out, gate.numel(), BLOCK=_BLOCK)
    return out


@kernel
def _swiglu(gate_ptr: tl.tensor, up_ptr: tl.tensor, out_ptr: tl.tensor, count: tl.tensor, BLOCK: tl.constexpr) -> None:
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    is_inside = at < count
    gate = tl.load(gate_ptr + at, mask=is_inside, other=0.0).to(tl.float32)
    up = tl.load(up_ptr + at, mask=is_inside, other=0.0).to(tl.float32)
    tl.store(out_ptr + at, (gate * tl.sigmoid(gate) * up).to(out_ptr.dtype.element_ty), mask=is_inside)
