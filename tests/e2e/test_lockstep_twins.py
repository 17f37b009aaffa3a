"""Lockstep is reproducible to the bit, and processes and transport change nothing in it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from clock.check import disagreements

pytestmark = [pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow]

Run = Callable[..., "subprocess.CompletedProcess[str]"]
EPISODE = ("--seed", "7", "--max-steps", "80", "--no-progress")
AGE_NS = 300_000_000


@pytest.fixture(scope="module")
def twins(
    run_module: Run, episode_in: Callable[[Path], Any], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """The same episode in one process and in three, side by side, which changes nothing."""
    ways = {"alone": "--in-process", "zenoh": "--local"}
    folders = {name: tmp_path_factory.mktemp(name) for name in ways}
    with ThreadPoolExecutor() as pool:
        done = pool.map(lambda name: run_module("sim_client", ways[name], *EPISODE, "--out", str(folders[name])), ways)
        assert {each.returncode for each in done} == {0}
    return {name: episode_in(folder) for name, folder in folders.items()}


def test_one_seed_gives_one_stream(twins: dict[str, Any]) -> None:
    assert len(twins["alone"].record.ticks) == 80
    assert twins["zenoh"].result["stream_sha256"] == twins["alone"].result["stream_sha256"]


@pytest.mark.parametrize("name", ["alone", "zenoh"])
def test_the_papers_schedule_gives_every_invocation_a_cognition_of_300_ms(twins: dict[str, Any], name: str) -> None:
    invocations = twins[name].record.invocations
    assert [i.age_ns for i in invocations] == [AGE_NS] * 4
    assert [i.ref_query for i in invocations] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["alone", "zenoh"])
def test_every_decision_follows_from_the_log(twins: dict[str, Any], name: str) -> None:
    assert not twins[name].record.recovered
    assert next(disagreements(twins[name].record), None) is None
