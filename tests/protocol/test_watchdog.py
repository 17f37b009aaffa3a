"""systemd hears from a process that works, and not from one whose loop hangs."""

from __future__ import annotations

import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.bus import LocalBus
from protocol.link import Link
from protocol.messages import Health, ServingState
from protocol.metrics import End, Metrics
from protocol.watchdog import watchdog

PERIOD_US = 30_000


@pytest.fixture
def systemd() -> Iterator[socket.socket]:
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(Path(folder) / "notify"))
        listener.settimeout(0.3)
        yield listener


def metrics_of(*, silent_ns: int) -> Metrics:
    metrics = Metrics()
    link = Link(LocalBus(), robot="r0", proc="ponder")
    health = Health(state=ServingState.READY)
    metrics.watch(End(link=link, health=lambda: health, silent_ns=lambda: silent_ns))
    return metrics


def environment(systemd: socket.socket) -> dict[str, str]:
    return {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": str(PERIOD_US)}


def test_a_process_that_works_is_reported(systemd: socket.socket) -> None:
    with watchdog(metrics_of(silent_ns=0), environment(systemd)):
        assert [systemd.recv(64) for _ in range(2)] == [b"WATCHDOG=1"] * 2


def test_a_process_that_hangs_is_not(systemd: socket.socket) -> None:
    with watchdog(metrics_of(silent_ns=20_000_000_000), environment(systemd)), pytest.raises(TimeoutError):
        systemd.recv(64)


def test_without_systemd_nobody_is_told(systemd: socket.socket) -> None:
    with watchdog(metrics_of(silent_ns=0), {"NOTIFY_SOCKET": systemd.getsockname()}), pytest.raises(TimeoutError):
        systemd.recv(64)
