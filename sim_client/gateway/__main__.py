"""``pp-gateway``: clients of other protocols drive our robot."""

from __future__ import annotations

import asyncio
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial

from clock.policies import policy_of, servers_of
from clock.service import ClockService, ServiceConfig
from clock.status import end_of
from protocol import files
from protocol.command_line import command, parse
from protocol.errors import TransportError
from protocol.link import Link
from protocol.logs import set_up_logging
from protocol.messages import Health, ServingState
from protocol.metrics import End, Metrics
from protocol.options import LinkOptions
from protocol.process import ENDING_S, StopFlag
from protocol.sockets import endpoint
from protocol.status import status_of
from protocol.version import version
from protocol.zenoh_bus import open_bus
from sim_client.gateway.groot import GrootDialect
from sim_client.gateway.http_form import HttpSide
from sim_client.gateway.lerobot_side import LerobotSide
from sim_client.gateway.machine import Machine
from sim_client.gateway.memory import Memory
from sim_client.gateway.options import GatewayOptions
from sim_client.gateway.seats import Seats, seat_names
from sim_client.gateway.websocket import WebsocketSide
from sim_client.launch import Daemons, local_link

log = logging.getLogger("pp-gateway")


@command("pp-gateway")
def main(argv: list[str] | None = None) -> int:
    options = parse(GatewayOptions, argv, prog="pp-gateway")
    should_stop = StopFlag(drains=True, sigterm_drains=options.operations.drain, ends_within_s=ENDING_S)
    metrics = Metrics()
    set_up_logging(options=options.operations)
    options.check()
    options.api_key()  # a bad file before servers are started
    if options.local or options.log.record:
        files.folder(options.out)
    with (
        status_of(metrics, options.operations, lambda: should_stop.is_draining),
        Daemons(options.out) as daemons,
        _seats(options, daemons, metrics) as seats,
    ):
        if options.local:
            seats.await_servers(should_stop)  # a client that finds the door open expects to be served
        with _serving(options, seats):
            mode = "realtime" if options.is_realtime else "lockstep"
            log.info("ready dialect=%s listen=%s mode=%s", options.dialect, options.listen, mode)
            seats.run(should_stop, lambda: should_stop.is_draining)
    return 0


@contextmanager
def _seats(options: GatewayOptions, daemons: Daemons, metrics: Metrics) -> Iterator[Seats]:
    link, robots = options.link, seat_names(options.link.robot, options.seats)
    if options.local:
        link = local_link(
            daemons,
            link,
            other_robots=robots[1:],
            with_clock=options.runs_clock_daemon,
            allow_starved=options.timing.allow_starved,
            with_ponder=options.ponder == "serve",
            ponder_checkpoint=options.ponder_checkpoint,
            pounce_checkpoint=options.pounce_checkpoint,
        )
        if options.runs_clock_daemon:
            log.info("to let a stopped robot move again: pp-engage --link.connect %s", link.connect[0])
    with ExitStack() as opened:
        if options.watch is not None:
            # Not among the servers: an episode goes on without a page.
            link = _watched(opened.enter_context(Daemons(options.out)), link, options.watch)
        machines = [_machine(options, replace(link, robot=robot), daemons, metrics, opened) for robot in robots]
        # An HTTP client is its host: it comes back under the same name.
        yield Seats(machines, resets_inherit=not options.is_realtime and options.dialect != "challenge-http")


def _watched(daemons: Daemons, link: LinkOptions, listen: str) -> LinkOptions:
    """Starts a page for the robot of ``link``; returns how to reach it as well."""
    at_viewer = endpoint("viewer", daemons.sockets())
    arguments = ["--listen", listen, "--link.robot", link.robot, "--link.listen", at_viewer]
    daemons.start("watch", "sim_client.watch", [*arguments, "--link.connect", *link.connect])
    return replace(link, connect=(*link.connect, at_viewer))


def _machine(
    options: GatewayOptions, link: LinkOptions, daemons: Daemons, metrics: Metrics, opened: ExitStack
) -> Machine:
    bus = open_bus(link)
    opened.callback(bus.close)
    robot = Link(bus, robot=link.robot, proc="sim")
    health = Health(state=ServingState.READY, version=version())
    metrics.watch(End(link=robot, health=lambda: health, silent_ns=lambda: 0))  # a request may wait for minutes
    clock = None
    if not options.runs_clock_daemon:
        servers = servers_of(policy_of(options.ponder))
        config = ServiceConfig(allow_starved=options.timing.allow_starved, servers=servers)
        at_clock = Link(bus, robot=link.robot, proc="clock")
        clock = ClockService(at_clock, config)
        metrics.watch(end_of(clock, at_clock, lambda: 0))
    return Machine(options.plan(), robot, clock, daemons.dead)


@contextmanager
def _serving(options: GatewayOptions, seats: Seats) -> Iterator[None]:
    """Listens in its own thread for as long as the block lasts. Raises TransportError if it cannot."""
    host, port = options.address
    max_bytes, terms = options.clients.max_message_mb << 20, options.terms()
    if options.dialect == "lerobot":
        lerobot = LerobotSide((host, port), seats, terms, options.seats)
        log.info("deployment=%s semantics=%s", lerobot.deployment.name, lerobot.deployment.semantics)
        with _in_thread(lerobot.serve_forever, lerobot.shutdown):
            yield
        return
    dialect = options.dialect_class()
    memory = Memory(options.clients.max_memory_mb << 20)
    if options.dialect == "challenge-http":
        http = HttpSide((host, port), seats, terms, dialect, max_bytes, options.api_key(), memory)
        with _in_thread(http.serve_forever, http.shutdown):
            yield
        http.server_close()
        return
    if issubclass(dialect, GrootDialect):
        try:
            from sim_client.gateway.zmq_side import ZmqSide
        except ModuleNotFoundError as error:
            raise TransportError(
                f"--dialect {options.dialect} needs {error.name}: pip install 'ponderpounce-server[groot]'"
            ) from error
        zmq = ZmqSide((host, port), seats, terms, partial(dialect, api_token=options.api_key()), max_bytes)
        with _in_thread(zmq.serve_forever, zmq.shutdown):
            yield
        return
    side = WebsocketSide(seats, terms, dialect, max_bytes, options.api_key(), memory)
    loop = asyncio.new_event_loop()
    server = loop.run_until_complete(side.start(host, port))

    def stop() -> None:
        loop.call_soon_threadsafe(server.close)
        asyncio.run_coroutine_threadsafe(server.wait_closed(), loop).result()
        loop.call_soon_threadsafe(loop.stop)

    with _in_thread(loop.run_forever, stop):
        yield
    loop.close()


@contextmanager
def _in_thread(work: Callable[[], None], stop: Callable[[], None]) -> Iterator[None]:
    thread = threading.Thread(target=work, name="network", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop()
        thread.join()


if __name__ == "__main__":
    sys.exit(main())
