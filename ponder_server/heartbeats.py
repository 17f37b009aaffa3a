"""Heartbeats from inside a forward pass, layer by layer.

The heartbeat comes from the working loop, and a server without one for 0.7 s counts as lost. A large network on a CPU,
or many pictures at once, takes longer than that for one forward pass.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from torch import nn

from ponder_server.contract import Progress, no_progress


@contextmanager
def heartbeats(modules: Iterable[nn.Module], progress: Progress) -> Iterator[None]:
    """Calls ``progress`` whenever one of the modules has run; its exceptions abort the forward pass."""
    handles = []
    if progress is not no_progress:
        handles = [module.register_forward_hook(lambda *_: progress()) for module in modules]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
