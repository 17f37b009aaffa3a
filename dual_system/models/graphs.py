"""CUDA graphs: work over static buffers, recorded once and replayed; the same interface without a GPU.

A replay repeats the recorded operations on the buffers' current contents. So captured work takes no arguments, returns
nothing, and has no control flow that depends on tensor values. The servers decide what to capture.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import torch

Work: TypeAlias = Callable[[], None]
Capture: TypeAlias = Callable[[Work], Work]
"""Takes work and returns its replay. It may run the work several times first: fill the buffers afterwards."""

WARM_UPS = 2
"""Runs before recording, in which kernels compile and libraries allocate workspaces: neither can be recorded."""


def directly(work: Work) -> Work:
    """Records nothing: every replay runs the work."""
    return work


def cuda_graph(work: Work, *, pool: Any = None, stream: torch.cuda.Stream | None = None) -> Work:
    """Records ``work`` on the current CUDA device; a replay is one launch, in the current stream.

    Args:
        pool: memory pool (``torch.cuda.graph_pool_handle``) for what ``work`` allocates; a private one if None.
        stream: stream on which to warm up and record; a new one each time if None.
    """
    side = stream or torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UPS):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=pool, stream=stream):
        work()
    return graph.replay


def cuda_graphs() -> Capture:
    """:func:`cuda_graph` for many graphs of which one runs at a time, on the current CUDA device.

    They share one memory pool, so a replay overwrites what an earlier one left there: results must lie in buffers
    that were allocated before. They share one stream as well, because libraries keep one workspace per stream.
    """
    return partial(cuda_graph, pool=torch.cuda.graph_pool_handle(), stream=torch.cuda.Stream())


def graphs_for(device: torch.device) -> Capture | None:
    """Default capture for work on ``device``: CUDA graphs on a GPU, None elsewhere."""
    return cuda_graphs() if device.type == "cuda" else None
