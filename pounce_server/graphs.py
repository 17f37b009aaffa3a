"""Work over static buffers, recorded once and replayed: CUDA graphs, and the same without a GPU.

A replay does what was recorded with whatever then lies in the buffers. So work that is captured takes nothing, returns
nothing, and decides nothing from the numbers it finds.
"""

from collections.abc import Callable
from typing import TypeAlias

import torch

Work: TypeAlias = Callable[[], None]
Capture: TypeAlias = Callable[[Work], Work]
"""Takes work, returns its replay. May run the work any number of times first: load the buffers afterwards."""

WARM_UPS = 2
"""Runs before recording: kernels are compiled and libraries take their workspaces, neither of which can be recorded."""


def directly(work: Work) -> Work:
    """Records nothing: every replay is a run."""
    return work


def cuda_graph(work: Work) -> Work:
    """Records ``work`` on the current CUDA device; a replay is one launch, in the current stream."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UPS):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return graph.replay
