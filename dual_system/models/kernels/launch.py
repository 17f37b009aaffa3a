"""Triton if it is installed, the conditions for running kernels, the checks of their tensors, and their time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor

try:
    import triton
    import triton.language as tl
except ModuleNotFoundError:
    triton = tl = None

__all__ = ["Timer", "Tolerance", "block_size", "check_tensor", "cuda_time_ms", "kernel", "missing_for", "tl"]

REPEATS = 20

Timer: TypeAlias = Callable[[Callable[[], object]], float]
"""Returns the duration of work, in any unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """Allowed difference between a kernel and its eager twin: |kernel - twin| <= atol + rtol * |twin|, elementwise."""

    rtol: float
    atol: float


def kernel(function: Callable[..., Any]) -> Any:
    """`triton.jit`, or the plain function without Triton, so that the module can be imported and its twin run.

    The environment variable TRITON_INTERPRET, read here, selects Triton's interpreter.
    """
    return function if triton is None else triton.jit(function)


def missing_for(device: torch.device) -> str:
    """Returns what to do before kernels can run on ``device``; empty if they can."""
    if triton is None:
        return "Triton is not installed: pip install 'ponderpounce-server[kernels]'"
    if device.type != "cuda" and not triton.knobs.runtime.interpret:
        return f"Triton compiles for a GPU, came device {device}: --device cuda (or, slowly, TRITON_INTERPRET=1)"
    return ""


def block_size(count: int) -> int:
    """The smallest power of two of at least ``count``: Triton's ranges need such lengths."""
    return 1 << (count - 1).bit_length()


def check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Raises ValueError unless ``tensor`` is contiguous and of this shape and dtype.

    Kernels do not check their pointers: with a wrong tensor they would read or write elsewhere in memory.
    """
    if tuple(tensor.shape) != shape or tensor.dtype != dtype or not tensor.is_contiguous():
        layout = "contiguous" if tensor.is_contiguous() else f"strides {tensor.stride()}"
        raise ValueError(
            f"{name}: expected {shape} {dtype} contiguous, came {tuple(tensor.shape)} {tensor.dtype} {layout}"
        )


def cuda_time_ms(work: Callable[[], object]) -> float:
    """Mean duration [ms] of `REPEATS` runs in the current stream, after a warm-up run."""
    work()
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(REPEATS):
        work()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end)) / REPEATS
