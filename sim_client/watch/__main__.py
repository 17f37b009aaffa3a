"""``pp-replay watch``: a robot's live status in a browser. It hears what is on the bus and says nothing there."""

from __future__ import annotations

import ipaddress
import logging
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from protocol.command_line import command, parse
from protocol.errors import TransportError
from protocol.link import Link
from protocol.logs import set_up_logging
from protocol.messages import Image
from protocol.options import LinkOptions
from protocol.process import ENDING_S, IDLE_WAIT_NS, StopFlag
from protocol.sockets import endpoint
from protocol.topics import COGNITION, EVENT, HEALTH, INFO, OBSERVATION, PHASE, SUBGOAL, TICK, alive_key
from protocol.zenoh_bus import open_bus
from sim_client.watch.page import served
from sim_client.watch.view import View

log = logging.getLogger("pp-replay watch")

# An episode's terms come first.
_TOPICS: tuple[Any, ...] = (INFO, OBSERVATION, TICK, COGNITION, SUBGOAL, EVENT, PHASE, HEALTH)
_KEEP = 512


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """Live status of a robot in a browser: cameras and their ages, the ladder, subgoals, lateness, processes."""

    listen: str = "127.0.0.1:8090"
    """HOST:PORT of the page."""
    open_to_anyone: bool = False
    """Let --listen be reached from other hosts: whoever reaches the port sees the cameras, without a password."""
    link: LinkOptions = field(
        default_factory=lambda: LinkOptions(
            listen=(endpoint("viewer"),), connect=tuple(map(endpoint, ("clock", "ponder", "pounce")))
        )
    )

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of ``listen``. Raises TransportError if it is neither HOST:PORT nor allowed."""
        host, _, port = self.listen.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise TransportError(f"--listen {self.listen!r}: expected HOST:PORT, e.g. 127.0.0.1:8090")
        host = host.strip("[]")
        if not self.open_to_anyone and not _is_loopback(host):
            raise TransportError(
                f"--listen {self.listen} can be reached from other hosts: use 127.0.0.1, or say --open-to-anyone"
            )
        return host, int(port)


class Watcher:
    """One robot's view, filled by one thread and read by the page's."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._view = View(link.robot)
        self._lock = threading.Lock()
        self._streams = [link.subscribe(topic, keep=2 if topic is OBSERVATION else _KEEP) for topic in _TOPICS]
        self._tokens = link.bus.watch_alive(alive_key(link.robot, "*"))

    def step(self) -> None:
        """Takes what has come."""
        with self._lock:
            for sample in self._tokens.drain():
                self._view.on_token(sample.key.rpartition("/")[2], bool(sample.payload))
            for stream in self._streams:
                for message in stream.drain():
                    self._view.on_message(message, time.monotonic_ns())

    def status(self) -> dict[str, Any]:
        with self._lock:
            return self._view.status(time.monotonic_ns())

    def picture(self, camera: str) -> Image | None:
        """A camera's newest picture; None if there is no such camera."""
        with self._lock:
            found = self._view.cameras.get(camera)
        return found.image if found is not None else None


@command("pp-replay watch")
def main(argv: list[str] | None = None, prog: str = "pp-replay watch") -> int:
    options = parse(WatchOptions, argv, prog=prog)
    should_stop = StopFlag(ends_within_s=ENDING_S)
    set_up_logging()
    address = options.address
    bus = open_bus(options.link)
    try:
        watcher = Watcher(Link(bus, robot=options.link.robot, proc="viewer"))
        with served(address, watcher.status, watcher.picture) as port:
            log.info("ready url=http://%s:%d/ robot=%s", address[0], port, options.link.robot)
            while not should_stop():
                watcher.step()
                bus.wait(IDLE_WAIT_NS)
    finally:
        bus.close()
    return 0


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


if __name__ == "__main__":
    sys.exit(main())
