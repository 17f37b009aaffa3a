"""A server's ends of the bus when several robots share its network: each robot has its own link and heartbeat.

A robot's name is its seat: it is part of every key, so what one robot sends or is sent never reaches another's link.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.process import host_clock_id


def check_robots(robots: Sequence[str]) -> None:
    """Raises ValueError if two robots have one name."""
    for index, robot in enumerate(robots):
        if robot in robots[:index]:
            raise ValueError(
                f"--other-robots: {robot!r} is named twice, with --link.robot counted; expected other names"
            )


class Ends:
    """``link`` and ``heartbeat`` are the first robot's; the others are created here, on the same bus."""

    def __init__(self, link: Link, heartbeat: Heartbeat, version: str, other_robots: Sequence[str]) -> None:
        self._ends = [(link, heartbeat)]
        for robot in other_robots:
            other = Link(link.bus, robot=robot, proc=link.proc)
            self._ends.append((other, Heartbeat(other, version, host_clock_id())))

    def __iter__(self) -> Iterator[tuple[Link, Heartbeat]]:
        return iter(self._ends)

    def __len__(self) -> int:
        return len(self._ends)

    def warming(self) -> None:
        for _, heartbeat in self._ends:
            heartbeat.set(state=ServingState.WARMING)

    def beat(self) -> None:
        """Every robot's heartbeat: they share one loop, so one that hangs hangs for all."""
        for _, heartbeat in self._ends:
            heartbeat.beat()
