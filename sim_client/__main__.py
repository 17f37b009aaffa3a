"""``sim-client``: episodes from the command line."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any

import tyro
from tqdm import tqdm

import ponderpounce.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from clock.service import ClockService, ServiceConfig
from ponderpounce.tasks.task import TaskError, make_task, task_names
from protocol.bus import Bus, LocalBus
from protocol.errors import TransportError
from protocol.link import Link
from protocol.options import LinkOptions
from protocol.process import set_up_logging
from protocol.zenoh_bus import open_bus
from sim_client.config import SimOptions
from sim_client.launch import Daemons, start_local
from sim_client.suite import Suite


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(SimOptions, args=argv, prog="sim-client", description=SimOptions.__doc__)
    set_up_logging("WARNING")
    if options.list_tasks:
        print("\n".join(task_names()))
        return 0
    try:
        make_task(options.task)  # a mistyped name before anything is started
        with Daemons(options.out) as daemons:
            results = _run(options, daemons)
    except (TaskError, TransportError) as error:
        print(f"sim-client: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("sim-client: interrupted; finished episodes are in results.json", file=sys.stderr)
        return 130
    episodes = results["episodes"]
    for episode in episodes:
        print(
            f"{episode['task']} seed={episode['seed']} {episode['status']} steps={episode['steps']} {episode['reason']}"
        )
    print(f"{sum(e['success'] for e in episodes)} of {len(episodes)} succeeded; {options.out / 'results.json'}")
    return 1 if any(e["status"] == "ABORTED" for e in episodes) else 0


def _run(options: SimOptions, daemons: Daemons) -> dict[str, Any]:
    bus, others = _bus(options, daemons)
    try:
        clock = None
        if not options.runs_clock_daemon and options.policy == "servers":
            config = ServiceConfig(allow_starved=options.allow_starved, watches=not options.in_process)
            clock = ClockService(Link(bus, robot=options.link.robot, proc="clock"), config)
            others(clock.step)
        link = Link(bus, robot=options.link.robot, proc="sim")
        suite = Suite(options, link, clock, daemons.dead)
        with tqdm(total=options.episodes * options.max_steps, unit="tick", disable=not options.progress) as bar:

            def on_tick(episode: int, tick: int) -> None:
                bar.set_description(f"episode {episode + 1}/{options.episodes}", refresh=False)
                bar.update(episode * options.max_steps + tick - bar.n)

            return suite.run(on_tick)
    finally:
        bus.close()


def _bus(options: SimOptions, daemons: Daemons) -> tuple[Bus, Callable[[Callable[[], bool]], None]]:
    """The bus, and how to add one more party to it if all share this thread."""
    if options.in_process:
        if options.mode != "lockstep":
            raise TransportError("--in-process shares one thread: use --mode lockstep, or --local")
        bus = LocalBus()
        for module, checkpoint in (
            ("ponder_server.party", options.ponder_checkpoint),
            ("pounce_server.party", options.pounce_checkpoint),
        ):
            # By name: this package never imports torch, so a robot's computer can do without it.
            bus.add_party(importlib.import_module(module).build(bus, options.link.robot, checkpoint))
        return bus, bus.add_party
    link = options.link
    if options.local and options.policy == "servers":
        endpoints = start_local(
            daemons,
            robot=link.robot,
            with_clock=options.runs_clock_daemon,
            ponder=["--checkpoint", str(options.ponder_checkpoint)] if options.ponder_checkpoint else [],
            pounce=["--checkpoint", str(options.pounce_checkpoint)] if options.pounce_checkpoint else [],
            allow_starved=options.allow_starved,
        )
        link = LinkOptions(robot=link.robot, connect=endpoints)
    if options.policy == "oracle":
        return LocalBus(), lambda step: None
    return open_bus(link), lambda step: None


if __name__ == "__main__":
    sys.exit(main())
