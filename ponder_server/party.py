"""PONDER in somebody else's process and thread: the same server on an in-process bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ponder_server.__main__ import build_engine
from ponder_server.config import PonderOptions
from ponder_server.serve import PonderServer
from protocol.bus import Bus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.version import version


def build(bus: Bus, robot: str, checkpoint: Path | None) -> Callable[[], bool]:
    """A warm server's step function."""
    link = Link(bus, robot=robot, proc="ponder")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    server = PonderServer(link, build_engine(PonderOptions(checkpoint=checkpoint)), heartbeat, version())
    server.warm_up()
    server.ready()
    return server.step
