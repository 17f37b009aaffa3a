"""One robot, one client: who has it, and when somebody else may."""

from __future__ import annotations

from dataclasses import dataclass

from sim_client.gateway.exchange import Busy


@dataclass(slots=True)
class Lease:
    """Held from a client's first request until it finishes or leaves; a client that falls silent loses it to the next.

    ``idle_ns``: how long a holder may be silent before another one is let in.
    """

    idle_ns: int
    holder: str = ""
    _heard_ns: int = 0

    def take(self, client: str, now_ns: int) -> None:
        """Raises Busy while another client holds it."""
        silent_ns = now_ns - self._heard_ns
        if self.holder not in ("", client) and silent_ns < self.idle_ns:
            raise Busy(
                f"this robot is driven by {self.holder}, which asked {silent_ns / 1e9:.0f} s ago. Wait until it has "
                f"finished, or been silent for {self.idle_ns / 1e9:.0f} s; or start another pp-gateway with servers "
                "of its own."
            )
        self.holder, self._heard_ns = client, now_ns

    def leave(self, client: str) -> None:
        if self.holder == client:
            self.holder = ""
