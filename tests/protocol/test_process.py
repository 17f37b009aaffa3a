"""What a signal does to a daemon's loop."""

from __future__ import annotations

import faulthandler
import os
import signal
import subprocess
import sys

import pytest

from protocol.process import PARENT_VARIABLE, StopFlag


@pytest.mark.parametrize(
    ("sigterm_drains", "sent", "drains", "stops"),
    [
        (False, ["SIGTERM"], False, True),
        (False, ["SIGUSR1"], True, False),
        (False, ["SIGUSR1", "SIGTERM"], True, True),
        (True, ["SIGTERM"], True, False),
        (True, ["SIGTERM", "SIGTERM"], True, True),
        (True, ["SIGINT"], False, True),
    ],
)
def test_signals_drain_or_stop(sigterm_drains: bool, sent: list[str], drains: bool, stops: bool) -> None:
    flag = StopFlag(drains=True, sigterm_drains=sigterm_drains)
    for name in sent:
        signal.raise_signal(signal.Signals[name])
    assert (flag.is_draining, flag()) == (drains, stops)


def test_a_process_that_cannot_drain_leaves_the_signal_alone() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    StopFlag()
    assert signal.getsignal(signal.SIGUSR1) is before


STUCK = """
import signal, threading
from protocol.process import PARENT_VARIABLE, StopFlag

def of_the_bus():
    threading.Event().wait()

threading.Thread(target=of_the_bus, daemon=True).start()
should_stop = StopFlag(ends_within_s={ends_within_s})
signal.raise_signal(signal.{name})
assert should_stop()
threading.Event().wait({ending_s})
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_process_that_is_stuck_while_it_ends_tells_where_and_leaves(name: str) -> None:
    program = STUCK.format(ends_within_s=0.2, name=name, ending_s=600)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "in of_the_bus" in done.stderr  # every thread's place
    assert "in <module>" in done.stderr


def test_a_process_that_ends_in_time_ends_well() -> None:
    program = STUCK.format(ends_within_s=600, name="SIGTERM", ending_s=0)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_process_whose_parent_is_gone_is_told_to_end_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PARENT_VARIABLE, str(os.getpid()))  # not our parent's
    armed: list[float] = []
    monkeypatch.setattr(faulthandler, "dump_traceback_later", lambda after_s, **_: armed.append(after_s))
    flag = StopFlag(ends_within_s=7.0)
    assert (flag(), flag()) == (True, True)
    assert armed == [7.0]
