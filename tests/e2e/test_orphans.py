"""Whoever starts servers for itself may be killed at any time; they do not outlive it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sim_client.launch import free_ports

pytestmark = pytest.mark.e2e

PARENT = """
import sys, time
from pathlib import Path
from sim_client.launch import Daemons
daemons = Daemons(Path(sys.argv[1]))
process = daemons.start("clock", "clock", ["--link.robot", "r0", "--link.listen", sys.argv[2]])
print(process.pid, flush=True)
time.sleep(600)
"""


def test_a_daemon_leaves_when_who_started_it_is_killed(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    command = [sys.executable, "-c", PARENT, str(tmp_path), f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        try:
            assert parent.stdout is not None
            pid = int(parent.stdout.readline())
            _wait_for(lambda: "ready" in (tmp_path / "clock.log").read_text())
        finally:
            parent.kill()
    _wait_for(lambda: not _is_running(pid))


def _wait_for(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen"
        time.sleep(0.05)


def _is_running(pid: int) -> bool:
    """False also for a zombie that nobody collects."""
    status = Path(f"/proc/{pid}/status")
    try:
        os.kill(pid, 0)
        return "State:\tZ" not in status.read_text()
    except (ProcessLookupError, FileNotFoundError):
        return False
