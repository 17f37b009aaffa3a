"""Work over static buffers, recorded once and replayed: CUDA graphs, and the same without a GPU.

A replay does what was recorded with whatever then lies in the buffers. So work that is captured takes nothing, returns
nothing, and decides nothing from the numbers it finds. Which work is the business of who serves a network.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import torch

Work: TypeAlias = Callable[[], None]
Capture: TypeAlias = Callable[[Work], Work]
"""Takes work, returns its replay. May run the work any number of times first: load the buffers afterwards."""

WARM_UPS = 2
"""Runs before recording: kernels are compiled and libraries take their workspaces, neither of which can be recorded."""


def directly(work: Work) -> Work:
    """Records nothing: every replay is a run."""
    return work


def cuda_graph(work: Work, *, pool: Any = None, stream: torch.cuda.Stream | None = None) -> Work:
    """Records ``work`` on the current CUDA device; a replay is one launch, in the current stream.

    Args:
        pool: of memory (``torch.cuda.graph_pool_handle``) for what ``work`` allocates; its own if None.
        stream: on which it is run and recorded; another one each time if None.
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

    They share one pool of memory, so a replay overwrites what an earlier one left there: results must lie in buffers
    that were allocated before. They share one stream as well, because libraries keep a workspace for each.
    """
    return partial(cuda_graph, pool=torch.cuda.graph_pool_handle(), stream=torch.cuda.Stream())


def graphs_for(device: torch.device) -> Capture | None:
    """How work on ``device`` is captured by default: not at all but on a GPU."""
    return cuda_graphs() if device.type == "cuda" else None
