"""CUDA graphs: work over static buffers, recorded once and replayed; the same interface without a GPU.

A replay repeats the recorded operations on the buffers' current contents. So captured work takes no arguments, returns
nothing, and has no control flow that depends on tensor values. The servers decide what to capture.
"""

from collections.abc import Callable
from typing import TypeAlias

import torch

Work: TypeAlias = Callable[[], None]
Capture: TypeAlias = Callable[[Work], Work]
"""Takes work and returns its replay. It may run the work several times first: fill the buffers afterwards."""

WARM_UPS = 2
"""Runs before recording, in which kernels compile and libraries allocate workspaces: neither can be recorded."""


def directly(work: Work) -> Work:
    """Records nothing: every replay runs the work."""
    return work


def cuda_graphs(device: torch.device) -> Capture:
    """Records work on ``device``, for graphs of which one runs at a time; a replay is one launch.

    They share one memory pool, so a replay overwrites what an earlier one left there: results must lie in buffers
    that were allocated before. They share one stream as well, because libraries keep one workspace per stream.
    """
    with torch.cuda.device(device):  # streams, pools and graphs are the current device's
        pool, side = torch.cuda.graph_pool_handle(), torch.cuda.Stream()

    def capture(work: Work) -> Work:
        with torch.cuda.device(device):
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(WARM_UPS):
                    work()
            torch.cuda.current_stream().wait_stream(side)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, pool=pool, stream=side):
                work()
        return graph.replay

    return capture


def graphs_for(device: torch.device) -> Capture | None:
    """Default capture for work on ``device``: CUDA graphs on a GPU, None elsewhere."""
    return cuda_graphs(device) if device.type == "cuda" else None
