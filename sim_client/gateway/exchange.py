"""What a client asks and what it gets, in our words. A dialect translates its own messages to these and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Floats, Level, Mode, TaskStatus

Frames = Mapping[str, NDArray[np.uint8]]
"""Camera name -> (height, width, 3) RGB."""
Packet = bytes | str
"""What a websocket carries: one binary or one text frame."""


class Refused(Exception):
    """A request that gets a sentence instead of actions. Whoever sent it may go on with another one."""


class Busy(Refused):
    """The robot is another client's."""


class Seen(NamedTuple):
    """What the client's robot saw and felt at one tick."""

    frames: Frames
    state: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """What the client's robot sees now; it asks what to do next.

    ``begins``: a new episode, whatever was before. ``may_begin``: a new one if none is open; of a protocol that has no
    episodes. ``demo`` is the conditioning video at the control rate, read only where an episode begins. ``since``:
    what was seen at the ticks between the last request and this one, of a protocol that tells.
    """

    instruction: str
    frames: Frames
    state: Floats
    begins: bool
    may_begin: bool = False
    demo: Sequence[Frames] = ()
    since: Sequence[Seen] = ()
    task: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """The client's episode is over. Status ONGOING: it did not say how it ended."""

    status: TaskStatus = TaskStatus.ONGOING
    reason: str = "the client went on without saying how the episode ended"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """Commands for ``tick`` and the ticks after it, one row each, and the rung of the ladder that each came from."""

    rows_NA: Floats
    tick: int
    levels: tuple[Level, ...]


class Asked(NamedTuple):
    """One message of a client: what it wants of the robot, if anything, and what it is told whatever comes of it."""

    request: Step | Finish | None
    seq: int = 0
    reply: Packet | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """What a client may know before it asks, and where its dialect finds things.

    ``cameras`` are our names with the client's keys; an empty key: the client's pictures in their own order.
    """

    mode: Mode
    rows: int
    control_hz: int
    cameras: Mapping[str, str]
    state_key: str
    num_proprio: int
    version: str


class Dialect(Protocol):
    """One client's conversation. It keeps what its protocol leaves unsaid, so every connection has its own."""

    def greeting(self) -> Packet | None:
        """What is said before the client has said anything."""
        ...

    def read(self, packet: Packet) -> Asked:
        """Raises Refused: the packet is not of this dialect, or lacks what the robot needs."""
        ...

    def answer(self, asked: Asked, answer: Answer) -> Packet: ...

    def refuse(self, sentence: str) -> Packet:
        """The sentence in the dialect's own form of an error, for the packet read last."""
        ...
