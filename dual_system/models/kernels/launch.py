"""Triton if it is installed, the conditions for running kernels, the checks of their tensors, and their time."""

from __future__ import annotations

import functools
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

REPEATS = 10
"""Runs in a graph that is timed: its own launch is shared among them."""
REPLAYS = 5
"""Timed replays after a first; the shortest counts, because what else the machine does only adds."""

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
    """Duration [ms] of one run as servers run it: replayed from a CUDA graph, where launching costs the host nothing.

    Launched one by one, small work would take as long as its launches do, and a slow kernel of one launch would win
    against fast ones of two.

    Raises RuntimeError if the work cannot be captured.
    """
    side, graph = _side(torch.cuda.current_device()), torch.cuda.CUDAGraph()  # its memory is its own, and goes with it
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):  # around the capture too: one that fails leaves its stream the current one
        work()  # kernels compile and libraries allocate workspaces, neither of which can be captured
        with torch.cuda.graph(graph, stream=side):
            for _ in range(REPEATS):
                work()
    torch.cuda.current_stream().wait_stream(side)
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    took_ms = []
    for _ in range(1 + REPLAYS):
        start.record()
        graph.replay()
        end.record()
        end.synchronize()
        took_ms.append(float(start.elapsed_time(end)))
    return min(took_ms[1:]) / REPEATS


@functools.cache
def _side(device: int) -> torch.cuda.Stream:
    """One stream for all captures of a device: libraries keep a workspace per stream."""
    return torch.cuda.Stream(device)
