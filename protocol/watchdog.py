"""Tells systemd that a process works, so that it restarts one that hangs (``WatchdogSec=`` of its unit)."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from protocol.metrics import Metrics


@contextmanager
def watchdog(metrics: Metrics, environment: Mapping[str, str] = os.environ) -> Iterator[None]:
    """Reports for as long as the block lasts, and as long as ``/healthz`` would say 200; nothing without systemd."""
    address, period_us = environment.get("NOTIFY_SOCKET", ""), int(environment.get("WATCHDOG_USEC", "0"))
    if not address or not period_us:
        yield
        return
    is_over = threading.Event()

    def report() -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
            while not is_over.wait(period_us / 3e6):  # systemd asks for at least two reports a period
                if not any(end.hang for end in metrics.ends):
                    with contextlib.suppress(OSError):  # its queue is full: the next one will do
                        systemd.sendto(b"WATCHDOG=1", address.replace("@", "\0", 1))

    thread = threading.Thread(target=report, name="watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
