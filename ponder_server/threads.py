"""Threads that share out the pieces of one large computation.

torch's own threads divide every product of the network, and most of them are too small to gain by it: they stay at one
(``config.NUM_TORCH_THREADS``). What is large enough is handed out here in pieces that do not depend on each other.
Whoever is free takes the next piece, the caller among them. A helper whose core is busy elsewhere takes none, and costs
nobody more time than the piece that it has begun.

Which pieces there are is the caller's affair: where that does not depend on the number of threads, no bit does.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias

import torch

Piece: TypeAlias = Callable[[], None]
"""Writes its result where no other piece writes."""


def num_usable_cores() -> int:
    """Of those in the machine, the ones that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Threads:
    """``count`` of them, the caller's own included; the others wait for work and end with this object."""

    def __init__(self, count: int) -> None:
        assert count >= 1, "the caller's own thread is one"
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, "threads") if count > 1 else None

    def do(self, pieces: Iterable[Piece]) -> None:
        """Returns when all of them are done. Raises what one of them raised, when no piece is under way any more."""
        left = deque(pieces)
        is_inference = torch.is_inference_mode_enabled()  # a thread's own affair
        num_helpers = min(self.count, len(left)) - 1
        begun = [self._pool.submit(_work_off, left, is_inference) for _ in range(num_helpers)] if self._pool else []
        try:
            _work_off(left, is_inference)
        finally:
            left.clear()
            for helper in begun:
                if not helper.cancel():  # one that has not even woken up is not waited for
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
