"""Common parts of the daemons: the loop in one thread, a stop flag set by signals, greppable log lines."""

from __future__ import annotations

import faulthandler
import gc
import os
import platform
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from protocol.bus import Bus

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

ENDING_S = 30.0
"""What a daemon has to end in once it was told to: an episode's log is closed, its servers are told and end in 5 s."""
IDLE_WAIT_NS = 20_000_000  # an idle daemon steps this often: its heartbeat depends on it
_STDERR = 2

PARENT_VARIABLE = "PONDERPOUNCE_PARENT_PID"
"""Environment variable with the process id of a parent; a daemon that has it exits when the parent is gone."""


class StopFlag:
    """True after SIGTERM or SIGINT, or once the parent process died; the loop then ends normally.

    Args:
        drains: whether SIGUSR1 sets ``is_draining``: no new episodes, and the process leaves after the running one.
        sigterm_drains: whether the first SIGTERM does so too.
        ends_within_s: a process that has been stopped for so long and is still there is stuck: it tells on stderr where
            each of its threads is, and leaves with exit code 1. None: it may take its time.

    Attributes:
        asked_ns: when the loop last asked (monotonic), which shows that it turns.
    """

    def __init__(
        self, *, drains: bool = False, sigterm_drains: bool = False, ends_within_s: float | None = None
    ) -> None:
        self.is_set = False
        self.is_draining = False
        self.asked_ns = time.monotonic_ns()
        self._sigterm_drains, self._ends_within_s = sigterm_drains, ends_within_s
        self._parent_pid = int(os.environ.get(PARENT_VARIABLE, "0"))
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._set)
        if drains:
            signal.signal(signal.SIGUSR1, self._drain)

    def _set(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM and self._sigterm_drains and not self.is_draining:
            self.is_draining = True
        else:
            self._stop()

    def _drain(self, number: int, frame: FrameType | None) -> None:
        self.is_draining = True

    def _stop(self) -> None:
        if not self.is_set and self._ends_within_s is not None:
            # A thread of C, which needs no lock of Python's: one that is never given back may be why it is stuck.
            faulthandler.dump_traceback_later(self._ends_within_s, exit=True, file=_STDERR)
        self.is_set = True

    def __call__(self) -> bool:
        self.asked_ns = time.monotonic_ns()
        if self._parent_pid > 0 and os.getppid() != self._parent_pid:
            self._stop()
        return self.is_set


def run(bus: Bus, step: Callable[[], bool], should_stop: Callable[[], bool]) -> None:
    """Steps while there is work, and waits for the bus while there is none."""
    freeze_heap()
    while not should_stop():
        if not step():
            bus.wait(IDLE_WAIT_NS)


def freeze_heap() -> None:
    """Excludes all current objects from garbage collection.

    Otherwise a collection would traverse a model library's million objects in the middle of an episode.
    """
    gc.collect()
    gc.freeze()


def host_clock_id() -> str:
    """Name of this kernel's monotonic clock: processes with the same id can compare instants.

    The kernel's boot id, because two hosts may share a name, and containers of one kernel do not.
    """
    try:
        kernel = _BOOT_ID.read_text(encoding="utf-8").strip()[:8]
    except OSError:  # not Linux
        kernel = platform.node() or "host"
    return f"{kernel}/monotonic"
