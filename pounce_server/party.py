"""POUNCE in somebody else's process and thread: the same server on an in-process bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pounce_server.__main__ import build_engine
from pounce_server.config import PounceOptions
from pounce_server.serve import PounceServer
from protocol.bus import Bus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.version import version


def build(bus: Bus, robot: str, checkpoint: Path | None) -> Callable[[], bool]:
    """A warm server's step function."""
    link = Link(bus, robot=robot, proc="pounce")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    server = PounceServer(link, build_engine(PounceOptions(checkpoint=checkpoint)), heartbeat, version())
    server.warm_up()
    server.ready()
    return server.step
