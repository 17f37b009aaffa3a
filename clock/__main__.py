"""``clock-serve``: the clock service as its own process."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import ExitStack

from clock.config import ClockOptions
from clock.service import ClockService
from clock.status import end_of
from protocol.command_line import command, parse
from protocol.errors import TransportError
from protocol.link import Link
from protocol.logs import set_up_logging
from protocol.metrics import Metrics
from protocol.process import IDLE_WAIT_NS, StopFlag, freeze_heap
from protocol.status import status_of
from protocol.watchdog import watchdog
from protocol.zenoh_bus import open_bus

log = logging.getLogger("clock-serve")


@command("clock-serve")
def main(argv: list[str] | None = None) -> int:
    options = parse(ClockOptions, argv, prog="clock-serve")
    operations, robot = options.operations, options.link.robot
    should_stop = StopFlag(drains=True, sigterm_drains=operations.drain)
    metrics = Metrics()
    with ExitStack() as opened:
        try:
            set_up_logging(options=operations)
            opened.enter_context(status_of(metrics, operations, lambda: should_stop.is_draining))
            config = options.service()
            bus = open_bus(options.link)
        except (TransportError, ValueError, OSError) as error:
            print(f"clock-serve: {error}", file=sys.stderr)
            return 2
        opened.callback(bus.close)
        opened.enter_context(watchdog(metrics))
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
