"""Roofline: the least time for a part of a network on this device, from ceilings measured in the same run.

A part takes at least the time of its multiplications, and of reading its weights once, at the device's best rates. Both
rates are measured, with one large product and one large copy, not taken from a data sheet. So the fraction of the
roofline is comparable between a laptop's core and a GPU.
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
    """Best rates of a few runs."""

    flops_per_s: float
    bytes_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """Multiplications and weight bytes of a call. Attention that runs as one operation may be missing."""

    flops: int
    weight_bytes: int

    def least_ms(self, ceilings: Ceilings) -> float:
        return 1e3 * max(self.flops / ceilings.flops_per_s, self.weight_bytes / ceilings.bytes_per_s)


def measure_ceilings(device: torch.device, dtype: torch.dtype) -> Ceilings:
    """Measures one product and one copy, large enough for the device (on a CPU a second or two)."""
    num_bytes = 1 << 28 if device.type == "cpu" else 1 << 31
    source = torch.randn(num_bytes // 4, device=device)  # constant data would take less power, and so less time
    target = torch.empty_like(source)
    copy_s = _best_s(lambda: target.copy_(source), device)
    return Ceilings(flops_per_s=product_flops_per_s(device, dtype), bytes_per_s=2 * num_bytes / copy_s)


def product_flops_per_s(device: torch.device, dtype: torch.dtype) -> float:
    """Rate of the best of a few products, large enough for the device not to be measured by its launches."""
    side = 1024 if device.type == "cpu" else 8192
    left, right = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    return 2 * side**3 / _best_s(lambda: torch.mm(left, right), device)


def piece_of(call: Callable[[], Any]) -> Piece:
    """Runs ``call`` once and counts. Embedding tables are not counted, because few of their rows are read."""
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
