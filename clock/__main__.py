"""``clock-serve``: the clock service as its own process."""

from __future__ import annotations

import logging
import sys

from clock.config import ClockOptions
from clock.service import ClockService
from protocol.command_line import command, parse
from protocol.errors import TransportError
from protocol.link import Link
from protocol.process import IDLE_WAIT_NS, StopFlag, freeze_heap, set_up_logging
from protocol.zenoh_bus import open_bus

log = logging.getLogger("clock-serve")


@command("clock-serve")
def main(argv: list[str] | None = None) -> int:
    options = parse(ClockOptions, argv, prog="clock-serve")
    set_up_logging()
    should_stop = StopFlag()
    try:
        config = options.service()
        bus = open_bus(options.link)
    except (TransportError, ValueError, OSError) as error:
        print(f"clock-serve: {error}", file=sys.stderr)
        return 2
    service = ClockService(Link(bus, robot=options.link.robot, proc="clock"), config)
    log.info("ready robot=%s listen=%s", options.link.robot, ",".join(options.link.listen))
    freeze_heap()
    try:
        while not should_stop():
            if not service.step():
                bus.wait(service.wait_ns(IDLE_WAIT_NS))
    finally:
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
