"""Triton if it is installed, what keeps a kernel from running, and what every fused operation asks of its tensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

try:
    import triton
    import triton.language as tl
except ModuleNotFoundError:
    triton = tl = None

__all__ = ["Tolerance", "block_size", "check_tensor", "kernel", "missing_for", "tl"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """How far a kernel may be from its eager twin: |kernel - twin| <= atol + rtol * |twin|, elementwise."""

    rtol: float
    atol: float


def kernel(function: Callable[..., None]) -> Any:
    """`triton.jit`. Without Triton the plain function: its module can be imported, its twin can be run.

    The environment variable TRITON_INTERPRET, read here, decides between compiler and interpreter.
    """
    return function if triton is None else triton.jit(function)


def missing_for(device: torch.device) -> str:
    """Returns what has to be done before kernels can run on ``device``; empty if nothing."""
    if triton is None:
        return "Triton is not installed: pip install 'ponderpounce-server[kernels]'"
    if device.type != "cuda" and not triton.knobs.runtime.interpret:
        return f"Triton compiles for a GPU, came device {device}: --device cuda (or, slowly, TRITON_INTERPRET=1)"
    return ""


def block_size(count: int) -> int:
    """The smallest power of two that holds ``count``: Triton's ranges have such lengths only."""
    return 1 << (count - 1).bit_length()


def check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Raises ValueError unless ``tensor`` is contiguous and of this shape and type.

    A kernel believes its pointers: a misfit would not fail, it would read or write somewhere else.
    """
    if tuple(tensor.shape) != shape or tensor.dtype != dtype or not tensor.is_contiguous():
        layout = "contiguous" if tensor.is_contiguous() else f"strides {tensor.stride()}"
        raise ValueError(
            f"{name}: expected {shape} {dtype} contiguous, came {tuple(tensor.shape)} {tensor.dtype} {layout}"
        )
