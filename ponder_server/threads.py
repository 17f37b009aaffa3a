"""Threads that share the independent pieces of one large computation.

torch's own threads divide every matrix product, most of which are too small to gain, so torch uses one
(``config.NUM_TORCH_THREADS``). Large computations are divided here into pieces that the threads, the caller's
included, take from a queue. A helper whose core is busy takes none, and delays the others by one piece at most.

Results are bit-identical for any number of threads as long as the caller's pieces do not depend on that number.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias

import torch

Piece: TypeAlias = Callable[[], None]
"""Work that writes its result where no other piece writes."""


def num_usable_cores() -> int:
    """Number of the machine's cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Threads:
    """``count`` threads, the caller's included; the others wait for work and end with this object."""

    def __init__(self, count: int) -> None:
        assert count >= 1, "the caller's own thread is one"
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, "threads") if count > 1 else None

    def do(self, pieces: Iterable[Piece]) -> None:
        """Runs all pieces and returns when they are done. Raises a piece's exception once no piece is running."""
        left = deque(pieces)
        is_inference = torch.is_inference_mode_enabled()  # per thread
        num_helpers = min(self.count, len(left)) - 1
        begun = [self._pool.submit(_work_off, left, is_inference) for _ in range(num_helpers)] if self._pool else []
        try:
            _work_off(left, is_inference)
        finally:
            left.clear()
            for helper in begun:
                if not helper.cancel():  # do not wait for a helper that has not started
                    helper.result()


def _work_off(left: deque[Piece], is_inference: bool) -> None:
    with torch.inference_mode(is_inference):
        while True:
            try:
                piece = left.popleft()
            except IndexError:
                return
            piece()


ALONE = Threads(1)
