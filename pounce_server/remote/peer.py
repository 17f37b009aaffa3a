"""What the engine knows of a policy server, whatever its wire."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

from clock.timebase import NS_PER_S
from pounce_server.contract import Progress, no_progress
from protocol.peers.mapping import Key
from protocol.peers.translation import Values

_LOOK_S = 0.05  # while it waits the heartbeat goes on: it is the other process that does not move


class PeerError(ValueError):
    """A policy server that is not there, does not answer in time, or answers with an error."""


class Lost(PeerError):
    """A connection that ended, or could not be made: the server may come yet."""


@dataclass(slots=True)
class Patience:
    """How long an answer may take. While waiting, ask `look_s` again and again."""

    limit_s: float
    progress: Progress = no_progress
    _end_ns: int = 0

    def __post_init__(self) -> None:
        self._end_ns = time.monotonic_ns() + round(self.limit_s * NS_PER_S)

    @property
    def is_over(self) -> bool:
        return time.monotonic_ns() >= self._end_ns

    def look_s(self) -> float:
        """Time in s to wait before the next look, at most 50 ms; calls ``progress``. Raises PeerError at the end."""
        self.progress()
        left_s = (self._end_ns - time.monotonic_ns()) / NS_PER_S
        if left_s <= 0:
            raise PeerError(f"no answer within {self.limit_s:g} s")
        return min(left_s, _LOOK_S)


class Peer(Protocol):
    """One policy server on its own wire. A method that raised leaves it closed; the next one connects anew."""

    def facts(self, patience: Patience) -> str:
        """Connects if need be, and returns what the server says of itself. Raises PeerError, OSError."""
        ...

    def begin(self, patience: Patience) -> None:
        """An episode begins. Raises PeerError, OSError."""
        ...

    def infer(self, values: Values, patience: Patience) -> dict[Key, Any]:
        """One answer: its arrays, each (rows, width) as they came. Raises PeerError, OSError."""
        ...

    def close(self) -> None: ...
