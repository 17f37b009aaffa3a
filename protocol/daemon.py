"""A daemon's place among the others: its logs, its status page, its bus and its watchdog, for as long as it lives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from protocol.logs import set_up_logging
from protocol.metrics import Metrics
from protocol.options import DaemonOptions, LinkOptions
from protocol.process import ENDING_S, StopFlag
from protocol.status import status_of
from protocol.watchdog import watchdog
from protocol.zenoh_bus import ZenohBus, open_bus


class Daemon(NamedTuple):
    """A process on the bus."""

    bus: ZenohBus
    metrics: Metrics
    should_stop: StopFlag


@contextmanager
def daemon(link: LinkOptions, operations: DaemonOptions) -> Iterator[Daemon]:
    """Joins the bus, and leaves it at the end of the block. SIGTERM and SIGINT set ``should_stop`` from now on.

    Raises:
        TransportError: the bus or the status page's port cannot be opened.
        OSError, ValueError: the log file cannot be written, or an option does not apply.
    """
    should_stop = StopFlag(drains=True, sigterm_drains=operations.drain, ends_within_s=ENDING_S)
    metrics = Metrics()
    set_up_logging(options=operations)
    with status_of(metrics, operations, lambda: should_stop.is_draining):
        bus = open_bus(link)
        try:
            with watchdog(metrics):
                yield Daemon(bus, metrics, should_stop)
        finally:
            bus.close()
