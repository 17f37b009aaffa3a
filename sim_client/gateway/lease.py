"""One robot, one client: which client holds the robot, and when another one may take over."""

from __future__ import annotations

from dataclasses import dataclass

from sim_client.gateway.exchange import Busy


@dataclass(slots=True)
class Lease:
    """The right to drive the robot, held from a client's first request until it finishes, leaves or stays idle.

    ``idle_ns``: time without a request after which another client may take the lease.
    """

    idle_ns: int
    holder: str = ""
    heard_ns: int = 0
    """When the holder asked last."""

    def acquire(self, client: str, now_ns: int) -> None:
        """Raises Busy while another client holds it."""
        silent_ns = now_ns - self.heard_ns
        if self.holder not in ("", client) and silent_ns < self.idle_ns:
            raise Busy(
                f"this robot is driven by {self.holder}, which asked {silent_ns / 1e9:.0f} s ago. Wait until it has "
                f"finished, or been silent for {self.idle_ns / 1e9:.0f} s; or start another pp-gateway with servers "
                "of its own."
            )
        self.holder, self.heard_ns = client, now_ns

    def release(self, client: str) -> None:
        """Gives it back if this client holds it."""
        if self.holder == client:
            self.holder = ""
