"""Workers: processes of this computer, or a Ray cluster. Results come in any order, one per job."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Generic, Protocol, TypeVar

from dual_system.data.errors import DatasetError

QUEUED_PER_WORKER = 2  # enough to keep it busy; a waiting result takes some megabytes
MAX_DEATHS = 3
_index = 0


class HasKey(Protocol):
    """A job that can be named."""

    @property
    def key(self) -> str: ...


JobT = TypeVar("JobT", bound=HasKey)
ResultT = TypeVar("ResultT")
ResultT_co = TypeVar("ResultT_co", covariant=True)


class Workers(Protocol[JobT, ResultT_co]):
    """Anything that runs jobs."""

    def run(self, jobs: Sequence[JobT]) -> Iterator[tuple[JobT, ResultT_co]]:
        """Yields each job with its result, in order of completion."""


class LocalWorkers(Generic[JobT, ResultT]):
    """Processes of this computer. When one is killed, the jobs that were under way are begun again.

    ``run`` raises DatasetError when workers die three times with no job finished in between.
    """

    def __init__(self, num_workers: int, work_out: Callable[[JobT], ResultT]) -> None:
        self._num_workers, self._work_out = num_workers, work_out

    def run(self, jobs: Sequence[JobT]) -> Iterator[tuple[JobT, ResultT]]:
        waiting = deque(jobs)
        deaths = 0
        while waiting:
            under_way: dict[Future[ResultT], JobT] = {}
            # Spawned: a forked child would share its parent's GL context.
            context = multiprocessing.get_context("spawn")
            started = context.Value("i", 0)
            with ProcessPoolExecutor(self._num_workers, context, initializer=_begin, initargs=(started,)) as pool:
                try:
                    while waiting or under_way:
                        while waiting and len(under_way) < QUEUED_PER_WORKER * self._num_workers:
                            under_way[pool.submit(self._work_out, waiting[0])] = waiting[0]
                            waiting.popleft()
                        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                            result = future.result()
                            deaths = 0
                            yield under_way.pop(future), result
                except BrokenProcessPool:
                    deaths += 1
                    waiting.extendleft(reversed(under_way.values()))
                    if deaths == MAX_DEATHS:
                        keys = ", ".join(sorted(job.key for job in under_way.values()))
                        raise DatasetError(
                            f"workers were killed {MAX_DEATHS} times in a row (out of memory? use fewer --workers) "
                            f"with these jobs under way: {keys}"
                        ) from None
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise


def worker_index() -> int:
    """Number of this worker among those of `LocalWorkers`, from 0 on; 0 in any other process."""
    return _index


def _begin(started: Any) -> None:
    global _index
    with started.get_lock():
        _index = started.value
        started.value += 1
    _leave_with_parent()


def _leave_with_parent() -> None:
    """Ends this process when its parent is killed; otherwise it would wait forever with its result."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=watch, name="parent-watch", daemon=True).start()


class RayWorkers(Generic[JobT, ResultT]):
    """A Ray cluster, on whose nodes this package is installed; results travel back, so no disk need be shared.

    ``address``: that of a running cluster (``auto``, ``ray://head:10001``), or ``local`` for one that is started here;
    ``num_gpus``: GPUs per job; with the default of none, Ray hides all GPUs from it.
    Raises DatasetError if Ray is not installed or the cluster does not answer.
    """

    def __init__(self, address: str, work_out: Callable[[JobT], ResultT], num_gpus: float = 0) -> None:
        try:
            self._ray: Any = importlib.import_module("ray")
        except ImportError:
            raise DatasetError("--ray needs Ray, which is not installed here: pip install 'ray>=2.50'") from None
        try:
            self._ray.init(address=None if address == "local" else address, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise DatasetError(f"no Ray cluster at {address!r}: {error}; start one with `ray start --head`") from None
        self._needed = {"CPU": 1, "GPU": num_gpus}
        self._remote = self._ray.remote(num_cpus=1, num_gpus=num_gpus, max_retries=MAX_DEATHS)(work_out)

    def run(self, jobs: Sequence[JobT]) -> Iterator[tuple[JobT, ResultT]]:
        there = self._ray.cluster_resources()
        num_workers = max(1, min(int(there.get(name, 0) / each) for name, each in self._needed.items() if each))
        waiting = deque(jobs)
        under_way: dict[Any, JobT] = {}
        while waiting or under_way:
            while waiting and len(under_way) < QUEUED_PER_WORKER * num_workers:
                job = waiting.popleft()
                under_way[self._remote.remote(job)] = job
            done, _ = self._ray.wait(list(under_way), num_returns=1)
            yield under_way.pop(done[0]), self._ray.get(done[0])
