"""Local workers: every job comes back once, also when workers are killed under way."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import pytest

from dual_system.data.episode import Package
from dual_system.data.errors import DatasetError
from dual_system.data.jobs import Look, jobs_of
from dual_system.data.rollout import work_out
from dual_system.data.workers import LocalWorkers, RayWorkers

JOBS = list(jobs_of(("StopCube",), 2, image_px=16, max_steps=1300, look=Look(execution_hz=1)))


@pytest.mark.e2e
@pytest.mark.sim
def test_a_killed_worker_s_jobs_are_done_again() -> None:
    packages = {}
    for job, package in LocalWorkers(1, work_out).run(JOBS):
        if not packages:
            for worker in multiprocessing.active_children():
                os.kill(worker.pid or 0, signal.SIGKILL)
        assert job.key not in packages
        packages[job.key] = package
    assert packages == {job.key: work_out(job) for job in JOBS}


def test_workers_that_keep_dying_are_given_up_with_the_jobs_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def dies(pool: ProcessPoolExecutor, *call: object) -> Future[Package]:
        future: Future[Package] = Future()
        future.set_exception(BrokenProcessPool())
        return future

    monkeypatch.setattr(ProcessPoolExecutor, "submit", dies)
    with pytest.raises(DatasetError, match=r"3 times in a row.*StopCube/000000"):
        list(LocalWorkers(1, work_out).run(JOBS))


def test_ray_is_asked_for_by_name() -> None:
    with pytest.raises(DatasetError, match="pip install"):
        RayWorkers("auto", work_out)
