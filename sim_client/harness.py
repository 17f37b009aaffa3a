"""Everything that episodes need around them, opened once: bus, servers, clock service, the robot's end."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from clock.policies import has_ponder
from clock.service import ClockService, ServiceConfig
from protocol.bus import Bus, LocalBus
from protocol.errors import TransportError
from protocol.link import Link
from protocol.zenoh_bus import open_bus
from sim_client.config import SimOptions
from sim_client.launch import Daemons, local_link

ServerStep = Callable[[], bool]
"""One turn of a server that shares this thread; returns whether there was anything to do."""
BuildServer = Callable[[Bus, str, Path | None], ServerStep]
"""Makes a warm server on a bus, for a robot and from a checkpoint; returns its step function."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Harness:
    """Plays any number of episodes, one after the other. The caller that opened it closes the bus."""

    bus: Bus
    link: Link
    clock: ClockService | None


def open_harness(options: SimOptions, daemons: Daemons, ponder: BuildServer | None = None) -> Harness:
    """Starts the servers that the options ask for.

    Args:
        daemons: stops those that are started as processes.
        ponder: in process, a server in place of ``ponder-serve``'s.

    Raises:
        TransportError: a bus that cannot be opened, or options that contradict each other.
    """
    options.check()
    bus, add_participant = _bus(options, daemons, ponder)
    try:
        clock = None
        if not options.runs_clock_daemon and options.policy == "servers":
            config = ServiceConfig(allow_starved=options.schedule.allow_starved, watches=not options.in_process)
            clock = ClockService(Link(bus, robot=options.link.robot, proc="clock"), config)
            add_participant(clock.step)
        return Harness(bus=bus, link=Link(bus, robot=options.link.robot, proc="sim"), clock=clock)
    except BaseException:
        bus.close()
        raise


def _bus(options: SimOptions, daemons: Daemons, ponder: BuildServer | None) -> tuple[Bus, Callable[[ServerStep], None]]:
    """Returns the bus, and how to add one more server to it if all share this thread."""
    link = options.link
    if options.policy == "oracle":
        return LocalBus(), lambda step: None
    if options.in_process:
        if options.mode != "lockstep":
            raise TransportError("--in-process shares one thread: use --mode lockstep, or --local")
        bus = LocalBus()
        models = options.models
        if has_ponder(options.played_by):
            build_ponder = ponder or partial(_builder("ponder_server.in_process"), **models.of_ponder())
            bus.add_participant(build_ponder(bus, link.robot, options.ponder_checkpoint))
        pounce = partial(_builder("pounce_server.in_process"), **models.of_pounce())
        bus.add_participant(pounce(bus, link.robot, options.pounce_checkpoint))
        return bus, bus.add_participant
    if options.local:
        link = local_link(
            daemons,
            link,
            with_clock=options.runs_clock_daemon,
            allow_starved=options.schedule.allow_starved,
            with_ponder=has_ponder(options.played_by),
            ponder_checkpoint=options.ponder_checkpoint,
            pounce_checkpoint=options.pounce_checkpoint,
            models=options.models,
        )
    return open_bus(link), lambda step: None


def _builder(module: str) -> Callable[..., ServerStep]:
    """Imports a server by name: this package never imports torch, so a robot's computer can do without it."""
    build: Callable[..., ServerStep] = importlib.import_module(module).build
    return build
