"""``python -m protocol.probe ponder``: checks that a process runs and works, for health checks of containers.

A liveliness token shows that the process exists, a READY heartbeat that its model is warm and its loop runs. The clock
service has no model and sends no heartbeat: only its token is checked.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field

import tyro

from protocol.command_line import parse
from protocol.errors import ProtocolError, TransportError
from protocol.link import Link
from protocol.messages import Health, ServingState
from protocol.options import LinkOptions
from protocol.topics import HEALTH, alive_key
from protocol.zenoh_bus import open_bus

HEARTBEATS = ("ponder", "pounce")
HEALTHY, UNHEALTHY, UNUSABLE = 0, 1, 2
_LOOK_AGAIN_NS = 20_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOptions:
    """Checks one process of a robot. Exit code 0: it is there and ready, 1: it is not, 2: the check failed."""

    proc: tyro.conf.Positional[str]
    """ponder, pounce, clock or sim."""
    link: LinkOptions = field(default_factory=LinkOptions)
    within_ms: int = 2000
    """Timeout of the check [ms]."""


def trouble(link: Link, proc: str, *, within_ns: int) -> str:
    """The problem of ``proc`` after ``within_ns``; returns "" as soon as there is none."""
    tokens = link.bus.watch_alive(alive_key(link.robot, proc))
    healths = link.subscribe(HEALTH, proc=proc)
    is_there, newest, deadline_ns = False, None, time.monotonic_ns() + within_ns
    while True:
        for sample in tokens.drain():
            is_there = bool(sample.payload)
        newest = next(reversed(healths.drain()), newest)
        why = _why(proc, is_there, newest)
        left_ns = deadline_ns - time.monotonic_ns()
        if not why or left_ns <= 0:
            return why
        link.bus.wait(min(_LOOK_AGAIN_NS, left_ns))


def _why(proc: str, is_there: bool, health: Health | None) -> str:
    if not is_there:
        return f"{proc} has no liveliness token: it does not run, or listens elsewhere"
    if proc not in HEARTBEATS:
        return ""
    if health is None:
        return f"{proc} runs, but no heartbeat came: its loop hangs"
    if health.state != ServingState.READY:
        return f"{proc} is {health.state.name.lower()} ({health.progress:.0%}) {health.detail}".strip()
    return ""


def main(argv: list[str] | None = None) -> int:
    options = parse(ProbeOptions, argv, prog="python -m protocol.probe")
    try:
        bus = open_bus(options.link)
        try:
            link = Link(bus, robot=options.link.robot, proc="probe")
            why = trouble(link, options.proc, within_ns=options.within_ms * 1_000_000)
        finally:
            bus.close()
    except (TransportError, ProtocolError) as error:
        sys.stderr.write(f"probe: {error}\n")
        return UNUSABLE
    sys.stdout.write((why or f"{options.proc} is ready") + "\n")
    return UNHEALTHY if why else HEALTHY


if __name__ == "__main__":
    sys.exit(main())
