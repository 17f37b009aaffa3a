"""A sign of life from inside a forward, layer by layer.

The heartbeat stops when the work stops, and a server silent for 0.7 s is taken for lost. A large network on a CPU, or
many pictures at once, takes longer than that for one forward.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from torch import nn

from ponder_server.contract import Progress, no_progress


@contextmanager
def audible(modules: Iterable[nn.Module], progress: Progress) -> Iterator[None]:
    """Within it, ``progress`` is called whenever one of the modules has run; what it raises ends the forward."""
    handles = []
    if progress is not no_progress:
        handles = [module.register_forward_hook(lambda *_: progress()) for module in modules]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
