"""A process of its own that stops the robot when commands stay away, whoever died or froze: the gateway, the network,
or the program itself.

It shares one number with the program, the instant at which the newest command expires, and waits for nobody. A robot
whose controller has a watchdog of its own (UR's RTDE has) should arm that one too: this process can be killed as well.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import signal
import time
import traceback
from typing import Any, Callable

_POLL_S = 0.005
_START_S = 120.0
"""It imports the program's own module again: LeRobot's takes a busy computer a minute."""
_END_S = 30.0
_ASLEEP, _ARMED, _FIRED, _CLOSED = 0, 1, 2, 3


def leave_holding() -> None:
    """``stop`` of a robot whose servos hold their last target by themselves: the program sends nothing from then on."""


class Watchdog:
    """Calls ``stop(*arguments)`` in its own process as soon as no newer command has come in time. It fires once.

    Args:
        stop: a function of a module, which finds the robot by itself: it shares nothing with the program.
        arguments: e.g. the robot's address.

    Raises:
        RuntimeError: its process did not start.
    """

    def __init__(self, stop: Callable[..., Any], *arguments: Any) -> None:
        spawn = multiprocessing.get_context("spawn")  # a fork would share the program's connections and locks
        self._until_ns = spawn.Value("q", 0, lock=False)  # without locks: a frozen program may hold one
        self._state = spawn.Value("i", _ASLEEP, lock=False)
        is_there = spawn.Event()
        target = (self._until_ns, self._state, is_there, os.getpid(), stop, arguments)
        self.process = spawn.Process(target=_watch, args=target, daemon=False, name="watchdog")
        self.process.start()
        until_s = time.monotonic() + _START_S
        while not is_there.wait(0.2):
            if not self.process.is_alive() or time.monotonic() > until_s:
                self.process.kill()
                raise RuntimeError("the watchdog's process did not start; see what it said above")
        atexit.register(self.close)

    @property
    def has_fired(self) -> bool:
        return bool(self._state.value == _FIRED)

    def feed(self, expires_ns: int) -> None:
        """The robot may go on until ``expires_ns`` (``time.monotonic_ns``); the first call arms the watchdog."""
        self._until_ns.value = expires_ns
        if self._state.value == _ASLEEP:
            self._state.value = _ARMED

    def rest(self) -> None:
        """Lets the watchdog sleep until it is fed again, after it fired too: nothing is sent to the robot now."""
        self._state.value = _ASLEEP

    def close(self) -> None:
        """Ends its process. One that is armed fires first: a program that leaves in order lets it ``rest`` before."""
        atexit.unregister(self.close)
        until_s = time.monotonic() + _END_S
        while self._state.value == _ARMED and self.process.is_alive() and time.monotonic() < until_s:
            time.sleep(_POLL_S)
        self._state.value = _CLOSED
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()


def _watch(until_ns: Any, state: Any, is_there: Any, parent_pid: int, stop: Callable[..., Any], arguments: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the program's: it may still park the robot
    is_there.set()
    while state.value != _CLOSED:
        is_orphan = os.getppid() != parent_pid
        if state.value == _ARMED and (time.monotonic_ns() > until_ns.value or is_orphan):
            try:
                stop(*arguments)
                state.value = _FIRED
            except Exception:  # the robot does not answer: try again, for as long as it takes
                traceback.print_exc()
        if is_orphan and state.value != _ARMED:
            return
        time.sleep(_POLL_S)
