"""How fast could this device do it? The least time for a piece of a network, from ceilings measured in the same run.

A piece takes at least as long as its multiplications at the device's own best rate, and as reading its weights once at
the device's own best rate. Both rates are measured: one large product, one large copy. So the share of the roofline
means the same on a laptop's core and on a GPU, and no figure of a data sheet is in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn.modules.module import register_module_forward_hook
from torch.utils.flop_counter import FlopCounterMode

_REPEATS = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceilings:
    """The best of a few tries."""

    flops_per_s: float
    bytes_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """What a call multiplies and which weights it reads. Attention that runs as one operation may be missing."""

    flops: int
    weight_bytes: int

    def least_ms(self, ceilings: Ceilings) -> float:
        return 1e3 * max(self.flops / ceilings.flops_per_s, self.weight_bytes / ceilings.bytes_per_s)


def measure_ceilings(device: torch.device, dtype: torch.dtype) -> Ceilings:
    """One product and one copy, large enough for the device (on a CPU a second or two)."""
    side, num_bytes = (1024, 1 << 28) if device.type == "cpu" else (8192, 1 << 31)
    left, right = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    source = torch.ones(num_bytes // 4, device=device)
    target = torch.empty_like(source)
    product_s = _best_s(lambda: torch.mm(left, right), device)
    copy_s = _best_s(lambda: target.copy_(source), device)
    return Ceilings(flops_per_s=2 * side**3 / product_s, bytes_per_s=2 * num_bytes / copy_s)


def piece_of(call: Callable[[], Any]) -> Piece:
    """Runs ``call`` once, counting. Rows of an embedding are not counted: few of them are read."""
    read: dict[int, int] = {}

    def note(module: nn.Module, *_: Any) -> None:
        if not isinstance(module, nn.Embedding):
            for tensor in (*module.parameters(recurse=False), *module.buffers(recurse=False)):
                read[id(tensor)] = tensor.numel() * tensor.element_size()

    hook = register_module_forward_hook(note)
    try:
        with FlopCounterMode(display=False) as counter:
            call()
    finally:
        hook.remove()
    return Piece(flops=counter.get_total_flops(), weight_bytes=sum(read.values()))


def _best_s(call: Callable[[], Any], device: torch.device) -> float:
    times_s = []
    for _ in range(_REPEATS):
        start_s = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times_s.append(time.perf_counter() - start_s)
    return min(times_s)
