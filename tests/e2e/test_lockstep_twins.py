"""Lockstep is reproducible to the bit, and processes and transport change nothing in it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from clock.check import disagreements
from sim_client import __main__ as sim_client

pytestmark = [pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow]

Run = Callable[..., "subprocess.CompletedProcess[str]"]
NUM_TICKS = 41
EPISODE = ("--seed", "7", "--max-steps", str(NUM_TICKS), "--no-progress")
AGE_NS = 300_000_000


@pytest.fixture(scope="module")
def twins(
    short_warm_up: None,
    run_module: Run,
    episode_in: Callable[[Path], Any],
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, Any]:
    """The same episode in this process and in three others, side by side, which changes nothing."""
    folders = {name: tmp_path_factory.mktemp(name) for name in ("alone", "zenoh")}
    alone, zenoh = ([*EPISODE, "--out", str(folder)] for folder in folders.values())
    with ThreadPoolExecutor() as pool:
        done = pool.submit(run_module, "sim_client", "--local", *zenoh)
        assert sim_client.main(["--in-process", *alone]) == 0
        assert done.result().returncode == 0
    return {name: episode_in(folder) for name, folder in folders.items()}


def test_one_seed_gives_one_stream(twins: dict[str, Any]) -> None:
    assert len(twins["alone"].record.ticks) == NUM_TICKS
    assert twins["zenoh"].result["stream_sha256"] == twins["alone"].result["stream_sha256"]


@pytest.mark.parametrize("name", ["alone", "zenoh"])
def test_the_papers_schedule_gives_every_invocation_a_cognition_of_300_ms(twins: dict[str, Any], name: str) -> None:
    invocations = twins[name].record.invocations
    assert [i.age_ns for i in invocations] == [AGE_NS] * 3
    assert [i.ref_query for i in invocations] == [0, 1, 2]


@pytest.mark.parametrize("name", ["alone", "zenoh"])
def test_every_decision_follows_from_the_log(twins: dict[str, Any], name: str) -> None:
    assert not twins[name].record.recovered
    assert next(disagreements(twins[name].record), None) is None
