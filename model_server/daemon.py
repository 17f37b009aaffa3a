"""A model server's life as a process: joins the bus, loads, warms up, serves until a stop signal."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

from model_server.shell import ModelShell
from protocol.daemon import daemon
from protocol.errors import CommandError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.metrics import End
from protocol.options import DaemonOptions, LinkOptions
from protocol.process import host_clock_id, run
from protocol.sockets import endpoint
from protocol.version import version

EngineT = TypeVar("EngineT")

_SHADOW_NICENESS = 10  # a ninth of the processor time of whatever drives, where there is not enough


class ModelServer(Protocol):
    """Interface of the shells of PONDER and POUNCE."""

    def warm_up(self) -> None: ...
    def ready(self) -> None: ...
    def step(self) -> bool: ...

    @property
    def shells(self) -> Sequence[ModelShell]:
        """One per robot, once it is warm."""
        ...


def serve_model(
    proc: str,
    link_options: LinkOptions,
    weights: str,
    load: Callable[[], EngineT],
    make: Callable[[Link, EngineT, Heartbeat, str], ModelServer],
    operations: DaemonOptions | None = None,
    *,
    is_shadow: bool = False,
) -> int:
    """Runs a model server until SIGTERM or SIGINT; returns the exit status.

    It joins the bus before it loads, so that others see it loading, or why it fails.

    Args:
        proc: "ponder" or "pounce".
        weights: description of the weights, for logs.
        load: builds the engine; raises OSError or ValueError with a message for the user.
        make: builds the server around the engine.
        operations: what it tells its operators, and how it leaves; None: logs on standard error.
        is_shadow: answer for the log only, beside the server that is used, and with a lower priority than whatever is.

    Raises:
        CommandError, OSError, ValueError: it could not start; the message is for the user.
    """
    if is_shadow:
        os.nice(_SHADOW_NICENESS)  # before there are threads: each has its own
        link_options = behind(link_options, proc)
    with daemon(link_options, operations or DaemonOptions()) as (bus, metrics, should_stop):
        link = Link(bus, robot=link_options.robot, proc=f"{proc}-shadow" if is_shadow else proc)
        heartbeat = Heartbeat(link, version(), host_clock_id())
        metrics.watch(_end(link, heartbeat))
        heartbeat.set(state=ServingState.LOADING, detail=weights)
        try:
            engine = load()
        except (CommandError, OSError, ValueError) as error:
            heartbeat.set(state=ServingState.FAILED, detail=str(error)[:2000])
            raise
        server = make(link, engine, heartbeat, version())
        try:
            server.warm_up()
        except Exception as error:  # whatever a kernel or the capture of a graph raises
            heartbeat.set(state=ServingState.FAILED, detail=f"warm-up: {error}"[:2000])
            raise
        for shell in server.shells:
            metrics.watch(_end(shell.link, shell.heartbeat, lambda shell=shell: shell.num_superseded))  # type: ignore[misc]
        server.ready()
        run(bus, server.step, lambda: should_stop() or (should_stop.is_draining and _is_drained(server)))
        heartbeat.set(state=ServingState.CLOSING)
    return 0


def behind(link: LinkOptions, proc: str) -> LinkOptions:
    """The link of ``proc``'s shadow: by default a socket of its own, and the clock service's."""
    listens = link.listen if link.listen != (endpoint(proc),) else (endpoint(f"{proc}-shadow"),)
    return replace(link, listen=listens, connect=link.connect or (endpoint("clock"),))


def _end(link: Link, heartbeat: Heartbeat, num_superseded: Callable[[], int] = lambda: 0) -> End:
    health, silent_ns = (lambda: heartbeat.health), (lambda: heartbeat.silent_ns)
    return End(link=link, health=health, silent_ns=silent_ns, num_superseded=num_superseded)


def _is_drained(server: ModelServer) -> bool:
    return all([shell.drain() for shell in server.shells])  # a list: every robot is told
