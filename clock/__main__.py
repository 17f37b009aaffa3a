"""``clock-serve``: the clock service as its own process."""

from __future__ import annotations

import logging
import sys
import time

from clock.config import ClockOptions
from clock.service import ClockService
from clock.status import end_of
from protocol.command_line import command, parse
from protocol.daemon import daemon
from protocol.link import Link
from protocol.process import IDLE_WAIT_NS, freeze_heap

log = logging.getLogger("clock-serve")


@command("clock-serve")
def main(argv: list[str] | None = None) -> int:
    options = parse(ClockOptions, argv, prog="clock-serve")
    config, robot = options.service(), options.link.robot
    with daemon(options.link, options.operations) as (bus, metrics, should_stop):
        link = Link(bus, robot=robot, proc="clock")
        service = ClockService(link, config)
        metrics.watch(end_of(service, link, lambda: time.monotonic_ns() - should_stop.asked_ns))
        log.info("ready robot=%s listen=%s", robot, ",".join(options.link.listen))
        freeze_heap()
        while not (should_stop() or (should_stop.is_draining and service.drain())):
            if not service.step():
                bus.wait(service.wait_ns(IDLE_WAIT_NS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
