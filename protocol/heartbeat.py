"""A heartbeat that stops when the work stops.

Zenoh's liveliness token belongs to the process and survives a hung model thread. This heartbeat is sent from inside the
work (between layers, tokens, flow steps), so its silence means that the work stopped.
"""

from __future__ import annotations

import time
from dataclasses import replace

from protocol.link import Link
from protocol.messages import Health, ServingState
from protocol.topics import HEALTH, alive_key

PERIOD_NS = 100_000_000


class Heartbeat:
    """Publishes ``Health``; ``beat`` is cheap enough to call anywhere, and sends at most every 100 ms."""

    def __init__(self, link: Link, version: str, clock_id: str) -> None:
        self._link = link
        self._clock_id = clock_id
        self._next_ns = 0
        self.health = Health(state=ServingState.LOADING, version=version)
        link.bus.declare_alive(alive_key(link.robot, link.proc))

    @property
    def silent_ns(self) -> int:
        """Time since the last beat; 0 until the server is ready, because loading does not beat."""
        is_ready = self.health.state == ServingState.READY
        return max(0, time.monotonic_ns() - self._next_ns + PERIOD_NS) if is_ready and self._next_ns else 0

    def set(self, **changes: object) -> None:
        """Changes the reported values; a change of state is sent immediately."""
        is_news = changes.keys() & {"state", "open_episode"}
        self.health = replace(self.health, **changes)  # type: ignore[arg-type]
        if is_news:
            self._next_ns = 0
        self.beat()

    def beat(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + PERIOD_NS
        health = replace(self.health, dropped={reason.value: count for reason, count in self._link.dropped.items()})
        self._link.publish(HEALTH, health, at_ns=now_ns, clock_id=self._clock_id)
