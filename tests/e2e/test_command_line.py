"""What a person sees who types something wrong: one sentence that names the way out, exit code 2, and no traceback."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e

Run = Callable[..., "subprocess.CompletedProcess[str]"]
SERVERS = ("clock", "ponder_server", "pounce_server")


def _refused(done: subprocess.CompletedProcess[str]) -> str:
    """What it said, having refused in good order."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


def test_a_mistyped_task_is_answered_with_the_one_that_was_meant(run_module: Run, tmp_path: Path) -> None:
    said = _refused(run_module("sim_client", "--task", "PickHighlights", "--out", str(tmp_path)))
    assert "unknown task 'PickHighlights'" in said
    assert "Did you mean 'PickHighlight'?" in said


def test_list_tasks_prints_one_name_per_line(run_module: Run) -> None:
    done = run_module("sim_client", "--list-tasks")
    assert done.returncode == 0
    assert "PickHighlight" in done.stdout.splitlines()


@pytest.mark.parametrize("module", ["sim_client", *SERVERS])
def test_an_unknown_option_is_an_error(run_module: Run, module: str) -> None:
    assert "--spped" in _refused(run_module(module, "--spped", "3"))


@pytest.mark.parametrize("module", SERVERS)
def test_an_endpoint_open_to_the_network_is_refused_without_tls(run_module: Run, module: str) -> None:
    said = _refused(run_module(module, "--link.listen", "tcp/0.0.0.0:0"))
    assert "tcp/0.0.0.0:0" in said
    assert "tls/" in said


@pytest.mark.parametrize("module", SERVERS)
def test_a_taken_port_is_named(run_module: Run, module: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert endpoint in _refused(run_module(module, "--link.listen", endpoint))


def test_one_thread_cannot_keep_real_time(run_module: Run, tmp_path: Path) -> None:
    said = _refused(run_module("sim_client", "--in-process", "--mode", "realtime", "--out", str(tmp_path)))
    assert "--mode lockstep" in said
