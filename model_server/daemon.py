"""A model server's life as a process: joins the bus, loads, warms up, serves until a stop signal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Protocol, TypeVar

from protocol.errors import TransportError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.options import LinkOptions
from protocol.process import StopFlag, host_clock_id, run, set_up_logging
from protocol.version import version
from protocol.zenoh_bus import open_bus

EngineT = TypeVar("EngineT")


class ModelServer(Protocol):
    """Interface of the shells of PONDER and POUNCE."""

    def warm_up(self) -> None: ...
    def ready(self) -> None: ...
    def step(self) -> bool: ...


def serve_model(
    proc: str,
    link_options: LinkOptions,
    weights: str,
    load: Callable[[], EngineT],
    make: Callable[[Link, EngineT, Heartbeat, str], ModelServer],
) -> int:
    """Runs a model server until SIGTERM or SIGINT; returns the exit status, 2 if it could not start.

    It joins the bus before it loads, so that others see it loading, or why it fails.

    Args:
        proc: "ponder" or "pounce".
        weights: description of the weights, for logs.
        load: builds the engine; raises OSError or ValueError with a message for the user.
        make: builds the server around the engine.
    """
    set_up_logging()
    should_stop = StopFlag()
    try:
        bus = open_bus(link_options)
    except TransportError as error:
        print(f"{proc}-serve: {error}", file=sys.stderr)  # noqa: T201
        return 2
    link = Link(bus, robot=link_options.robot, proc=proc)
    heartbeat = Heartbeat(link, version(), host_clock_id())
    try:
        heartbeat.set(state=ServingState.LOADING, detail=weights)
        try:
            engine = load()
        except (OSError, ValueError) as error:
            heartbeat.set(state=ServingState.FAILED, detail=str(error)[:2000])
            print(f"{proc}-serve: {error}", file=sys.stderr)  # noqa: T201
            return 2
        server = make(link, engine, heartbeat, version())
        try:
            server.warm_up()
        except Exception as error:  # whatever a kernel or the capture of a graph raises
            heartbeat.set(state=ServingState.FAILED, detail=f"warm-up: {error}"[:2000])
            raise
        server.ready()
        run(bus, server.step, should_stop)
        heartbeat.set(state=ServingState.CLOSING)
    finally:
        bus.close()
    return 0
