"""A run that is asked to stop saves first: on SIGTERM (of schedulers, torchrun, a slice's end) and on Ctrl-C."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Yields whether SIGTERM or SIGINT came; the second one acts at once, as outside of the block.

    Only the main thread gets signals: in another one there is never a request. A signal that is ignored (SIGINT under
    nohup) stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    requests: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    before = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
    mine = os.getpid()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def request(number: int, frame: FrameType | None) -> None:
        restore()
        requests.append(number)
        if os.getpid() != mine:  # a forked process has nothing to save
            os.kill(os.getpid(), number)

    for number in before:
        signal.signal(number, request)
    try:
        yield lambda: bool(requests)
    finally:
        restore()
