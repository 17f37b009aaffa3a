"""Episodes that cost nothing: a few rows of numbers and tiny pictures, all decided by a seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.data.episode import CAMERAS, About, EpisodeWriter, Package, Row
from dual_system.data.jobs import Job
from protocol.bus import LocalBus
from protocol.link import Link
from sim_client.config import LogOptions, SimOptions
from sim_client.suite import Suite

PX = 16


def make_row(rng: np.random.Generator, **changes: Any) -> Row:
    row = Row(
        state=rng.normal(size=8).astype(np.float32),
        action=rng.normal(size=8).astype(np.float32),
        tcp_pose=rng.normal(size=7).astype(np.float32),
        subgoal="press the button",
        grounded_subgoal="press the button at <3, 4>",
    )
    return dataclasses.replace(row, **changes)


def make_package(
    seed: int, *, num_rows: int = 5, num_demonstration_rows: int = 2, nudge_rad: float | None = None, **about: Any
) -> Package:
    """An episode that begins with a demonstration; every second row is rendered.

    With a nudge, what was executed is said, and is so far from the label.
    """
    rng = np.random.default_rng(seed)
    writer = EpisodeWriter(PX)
    for index in range(num_rows):
        is_demonstration = index < num_demonstration_rows
        pictures = {camera: rng.integers(0, 256, (PX, PX, 3), np.uint8) for camera in CAMERAS}
        reasoning = "it was the second one" if index == num_demonstration_rows > 0 else ""
        row = make_row(
            rng,
            is_demonstration=is_demonstration,
            is_transition=index == num_demonstration_rows,
            demonstration_reasoning=reasoning,
        )
        if nudge_rad is not None and not is_demonstration:
            row = dataclasses.replace(row, executed_action=row.action + np.float32(nudge_rad))
        writer.add(row, pictures if index % 2 == 0 else {})
    values: dict[str, Any] = {
        "task": "Numbers",
        "instruction": f"count to {seed % 2}",
        "seed": seed,
        "difficulty": "easy",
        "origin": "oracle",
        "is_success": True,
        "image_px": PX,
    }
    return writer.pack(About(**values | about))


def work_out(job: Job) -> Package:
    """What the oracle would have made of a job."""
    noise = {} if job.noise == "none" else {"nudge_rad": 0.5, "noise_rad": 0.01 * (job.slot % 2)}
    return make_package(job.seed(0), num_rows=3 + job.slot % 3, task=job.task, difficulty=job.difficulty, **noise)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Records what sim-client writes of an easy oracle episode; returns the log."""

    def record(task: str, seed: int, log: LogOptions) -> Path:
        out = tmp_path_factory.mktemp("recorded")
        options = SimOptions(task=task, seed=seed, difficulty="easy", policy="oracle", out=out, log=log)
        bus = LocalBus()
        results = Suite(options, Link(bus, robot="r0", proc="sim"), None, lambda: "").run()
        bus.close()
        return out / str(results["episodes"][0]["mcap"])

    return record


@pytest.fixture(scope="session")
def package() -> Callable[..., Package]:
    return make_package


@pytest.fixture(scope="session")
def pretend() -> Callable[[Job], Package]:
    return work_out
