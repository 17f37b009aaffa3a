"""A run that is told to end saves first: at SIGTERM (of schedulers, torchrun, a slice's end) and at Ctrl-C."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ending() -> Iterator[Callable[[], bool]]:
    """Yields whether this process has been told to end; told a second time it ends at once, as outside of the block.

    Only the main thread hears signals: in another one nobody is told.
    """
    told: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    mine = os.getpid()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def hear(number: int, frame: FrameType | None) -> None:
        restore()
        told.append(number)
        if os.getpid() != mine:  # a forked worker has nothing to save
            os.kill(os.getpid(), number)

    for number in before:
        signal.signal(number, hear)
    try:
        yield lambda: bool(told)
    finally:
        restore()
