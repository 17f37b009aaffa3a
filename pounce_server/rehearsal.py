"""Arguments of a stream's operations, to compare kernels with their twins on the card and at its shape."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dual_system.models.kernels.rms_norm import Residual
from pounce_server.fused_stream import Norm, Run
from pounce_server.kernels.rope import Slots

NAN = float("nan")


def rehearse(run: Run, norm: Norm, keys: Tensor, values: Tensor) -> dict[str, tuple[Any, ...]]:
    """Arguments by operation: random numbers in ``run``'s buffers, and NaN where a kernel must write all."""
    generator = torch.Generator(run.x.device).manual_seed(0)
    for read in (run.x, run.branch, run.qkv, run.gate_up, run.rotation.cos, run.rotation.sin):
        read.normal_(generator=generator)
    for written in (run.normed, run.queries, run.activated):
        written.fill_(NAN)
    return {
        "norm": (run.x, run.normed, norm.style, Residual(run.branch, norm.gate)),
        "rope": (run.qkv, run.rotation, run.queries, Slots(keys, values, run.first)),
        "geglu": (run.gate_up, run.activated),
    }
