"""Requests and answers of clients in our own types. A dialect converts its protocol's messages to these and back."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from clock.timebase import NS_PER_S
from protocol.messages import Floats, Level, Mode, Robot, RobotState, TaskStatus
from protocol.peers.mapping import PolicyMapping

log = logging.getLogger("pp-gateway")

Frames = Mapping[str, NDArray[np.uint8]]
"""Camera name -> (height, width, 3) RGB."""
Packet = bytes | str
"""One websocket message, a binary or a text frame."""


class Refused(Exception):
    """A request that gets an error message instead of actions. The client may continue with another one."""


class Busy(Refused):
    """Another client has the robot."""


class Failed(Refused):
    """The gateway could not handle a request: a defect of ours."""


def refusal(error: Exception, client: str) -> Refused:
    """The refusal that a client gets for ``error``, whatever a request has raised; logged, with a defect's traceback.

    Every side passes errors through here, so that no message ends a network thread or a connection.
    """
    if isinstance(error, Refused):
        log.warning("client=%s refused: %s", client, error)
        return error
    log.error("client=%s: a request failed", client, exc_info=error)
    return Failed(f"the gateway failed: {type(error).__name__}: {error}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """How a robot's own program runs an episode.

    ``speed``: share of the robot's step limits, (0, 1]. ``is_dry``: it sends nothing to the robot.
    """

    speed: float = 1.0
    is_dry: bool = False


class Observed(NamedTuple):
    """Observation of the client's robot at one tick."""

    frames: Frames
    state: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A request for actions, with the current observation of the client's robot.

    ``begins``: start a new episode in any case. ``may_begin``: start one if none is open, for protocols without
    episodes. ``demo`` is the conditioning video, used only at the start of an episode; ``demo_hz``, its frames a second
    (0: the control rate). ``since``: the observations between the last request and this one, for protocols that send
    them.

    A robot's own program says more: ``taken_ns``, the instant of ``state`` (this host's monotonic clock; None: now);
    ``captured_ns``, those of its pictures by camera (one without is as old as the state);
    what the robot says of itself; and, live, the newest tick that it was told of, to wait for a later one. ``trial``
    are its terms if the request only opens an episode.
    """

    instruction: str
    frames: Frames
    state: Floats
    begins: bool
    may_begin: bool = False
    demo: Sequence[Frames] = ()
    demo_hz: int = 0
    since: Sequence[Observed] = ()
    task: str = ""
    taken_ns: int | None = None
    captured_ns: Mapping[str, int] = field(default_factory=dict)
    robot_state: RobotState = RobotState.UNSPECIFIED
    robot_text: str = ""
    after_tick: int = -1
    trial: Trial | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """The client's episode is over. Status ONGOING: its outcome is unknown."""

    status: TaskStatus = TaskStatus.ONGOING
    reason: str = "the client went on without saying how the episode ended"
    is_reset: bool = False
    """A new episode is about to begin: whoever says so over a new connection may have left an old one open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Behind:
    """What is behind a command, as far as it is known: the newest subgoal that has come from PONDER with its age, age
    and gate score of the cognition that the command's chunk was conditioned on, and how long both models took."""

    subgoal: str = ""
    subgoal_age_ns: int = 0
    cognition_age_ns: int = 0
    gate_score: float | None = None
    ponder_ns: int = 0
    pounce_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """Commands for ``tick`` and the ticks after it, one row each, and the rung of the ladder that each came from.

    ``deadline_ns``: live, the deadline of ``tick`` on this host's monotonic clock.
    """

    rows_NA: Floats
    tick: int
    levels: tuple[Level, ...]
    deadline_ns: int = 0
    behind: Behind = Behind()

    @property
    def told(self) -> dict[str, Any]:
        """What a client hears beside the rows: the first one's tick, and what is behind it.

        No subgoal yet: "". No gate, no cognition, or none that has come: no score (None).
        """
        return {
            "tick": self.tick,
            "subgoal": self.behind.subgoal,
            "subgoal_age_s": self.behind.subgoal_age_ns / NS_PER_S,
            "cognition_age_s": self.behind.cognition_age_ns / NS_PER_S,
            "gate_score": self.behind.gate_score,
        }

    @property
    def level_names(self) -> list[str]:
        return [level.name for level in self.levels]


class ClientRequest(NamedTuple):
    """One message of a client: its request to the robot, if any, and a reply that needs no answer, if any."""

    request: Step | Finish | None
    seq: int = 0
    reply: Packet | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """Facts that a client may know before its first request, and the keys that its dialect reads.

    ``cameras`` are our names with the client's keys; an empty key: the client's pictures in their own order.
    ``robot`` is described for a state of zeros and pictures of one pixel. ``mapping``: names and units of a policy's
    client, for the dialects of GR00T and LeRobot. ``has_ponder``: PONDER's subgoals can be asked for.
    """

    mode: Mode
    rows: int
    control_hz: int
    cameras: Mapping[str, str]
    state_key: str
    robot: Robot
    version: str
    mapping: PolicyMapping | None = None
    has_ponder: bool = True

    @property
    def num_proprio(self) -> int:
        return self.robot.num_proprio


class Door(Protocol):
    """Where network threads hand in what clients ask: one robot, or several seats."""

    def submit(self, client: str, request: Step | Finish) -> Future[Answer | None]:
        """The future holds the answer (None of a Finish), or raises Refused.

        Raises:
            Busy: other clients have all there is.
            Refused: the gateway was stopped.
        """
        ...


class Dialect(Protocol):
    """One client's conversation. It may keep state between messages, so every connection has its own."""

    def greeting(self) -> Packet | None:
        """The message to send before the client's first one."""
        ...

    def read(self, packet: Packet) -> ClientRequest:
        """Parses a packet. Raises Refused if it is not of this dialect or is incomplete."""
        ...

    def answer(self, asked: ClientRequest, answer: Answer) -> Packet: ...

    def refuse(self, sentence: str) -> Packet:
        """The sentence in the dialect's own form of an error, for the packet read last."""
        ...
