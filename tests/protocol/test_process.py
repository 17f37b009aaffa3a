"""What a signal does to a daemon's loop."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from protocol.process import StopFlag

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    kept = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


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
