"""Batches prefetched by worker processes, because one process prepares them more slowly than a GPU consumes them.

A batch is a pure function of its step, so workers change nothing but the time. They are forked from a trainer that may
already use a GPU. That is safe because they use numpy and CPU tensors only and do not run torch's thread pools, so no
thread of the parent can hold a lock that they need.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dual_system.training.joint import PonderBatch, PounceBatch
from dual_system.training.trainer import Batches

_Batch = tuple[PonderBatch, PounceBatch]
_AHEAD = 2  # batches that each worker prefetches


class Prefetcher:
    """`Batches` for consecutive steps, made by worker processes."""

    def __init__(self, make: Batches, device: torch.device | str, num_workers: int) -> None:
        """``make`` returns a step's batch on the CPU. Raises ValueError for fewer than one worker."""
        if num_workers < 1:
            raise ValueError(f"expected at least one process that makes batches, came {num_workers}")
        self._make, self._device, self._num_workers = make, device, num_workers
        self._made: Iterator[_Batch] = iter(())
        self._step = -1
        self._next: Future[_Batch] | None = None
        self._moving = ThreadPoolExecutor(1, "batches")

    def __call__(self, step: int) -> _Batch:
        """The batch of ``step``, on the device. A step other than the next one discards the prefetched batches.

        Raises:
            Exception: the worker's exception.
        """
        if self._next is None or step != self._step:
            self._begin(step)
        assert self._next is not None
        batch = self._next.result()
        self._step += 1
        self._next = self._moving.submit(self._fetch)
        return batch

    def close(self) -> None:
        """Ends the workers."""
        self._moving.shutdown(wait=True, cancel_futures=True)
        end_workers = getattr(self._made, "_shutdown_workers", None)
        if end_workers is not None:  # after a worker's error, garbage collection alone would take 10 s for it
            end_workers()
        self._made = iter(())

    def _begin(self, step: int) -> None:
        if self._next is not None:
            self._next.exception()  # waits for the discarded batch and ignores its error
        loader = DataLoader(
            _Steps(self._make, step),
            batch_size=None,
            num_workers=self._num_workers,
            prefetch_factor=_AHEAD,
            collate_fn=_identity,
            multiprocessing_context="fork",
            worker_init_fn=_ignore_signals,
        )
        self._made, self._step = iter(loader), step
        self._next = self._moving.submit(self._fetch)

    def _fetch(self) -> _Batch:
        episodes, invocations = _with_tensors(next(self._made))
        return episodes.to(self._device), invocations.to(self._device)


class _Steps(Dataset[Any]):
    """The workers' dataset: item n is the batch of step ``first`` + n, with arrays in place of tensors.

    torch passes every tensor between processes by its own file descriptor, and a batch holds hundreds.
    """

    def __init__(self, make: Batches, first: int) -> None:
        self._make, self._first = make, first

    def __len__(self) -> int:
        return 1 << 40  # unlimited

    def __getitem__(self, index: int) -> _Batch:
        made: _Batch = _with_arrays(self._make(self._first + index))
        return made


def _ignore_signals(worker: int) -> None:
    """Ignores SIGTERM and SIGINT in a worker: schedulers, torchrun and a terminal send them to the workers too.

    The trainer ends its workers itself, after it has saved its step (`stop_requests`).
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def _identity(batch: Any) -> Any:
    return batch


def _with_arrays(value: Any) -> Any:
    """Replaces every tensor by an `_Array`."""
    return _mapped(value, Tensor, lambda tensor: _Array(tensor.numpy()))


def _with_tensors(value: Any) -> Any:
    return _mapped(value, _Array, lambda wrapped: torch.from_numpy(wrapped.array))


class _Array:
    """Marks an array that was a tensor; rows also contain plain arrays."""

    def __init__(self, array: Any) -> None:
        self.array = array


def _mapped(value: Any, kind: type, change: Any) -> Any:
    if isinstance(value, kind):
        return change(value)
    if isinstance(value, tuple):
        made = [_mapped(each, kind, change) for each in value]
        return type(value)(*made) if hasattr(value, "_fields") else tuple(made)
    if is_dataclass(value) and not isinstance(value, type):
        held = {each.name: getattr(value, each.name) for each in fields(value)}
        changed = {name: _mapped(each, kind, change) for name, each in held.items()}
        return replace(value, **{name: each for name, each in changed.items() if each is not held[name]})
    return value
