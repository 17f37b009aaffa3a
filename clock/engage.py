"""``pp-engage``: an operator allows motion again after the ladder stopped the robot."""

from __future__ import annotations

import getpass
import sys
from dataclasses import dataclass, field

from protocol.command_line import command, parse
from protocol.errors import CallFailed, CommandError
from protocol.link import Link
from protocol.messages import EngageRequest
from protocol.options import LinkOptions
from protocol.sockets import endpoint
from protocol.topics import ENGAGE
from protocol.zenoh_bus import open_bus

_CALL_NS = 2_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class EngageOptions:
    """Lets a stopped robot move again; the operator is logged."""

    link: LinkOptions = field(default_factory=lambda: LinkOptions(connect=(endpoint("clock"),)))
    operator: str = field(default_factory=getpass.getuser)
    """Name of the person who engages the robot; it is logged."""


@command("pp-engage")
def main(argv: list[str] | None = None) -> int:
    options = parse(EngageOptions, argv, prog="pp-engage")
    bus = open_bus(options.link)
    try:
        link = Link(bus, robot=options.link.robot, proc="engage")
        reply = link.call(ENGAGE, "clock", EngageRequest(operator=options.operator), timeout_ns=_CALL_NS)
    except CallFailed as error:
        raise CommandError(f"{error}. With --local, the log of pp-gateway has the whole command") from None
    finally:
        bus.close()
    sys.stdout.write(f"{reply.error or reply.level}\n")
    return 1 if reply.error else 0


if __name__ == "__main__":
    sys.exit(main())
