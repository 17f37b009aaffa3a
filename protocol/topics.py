"""Topics and calls: their names, key expressions and quality of service.

The root is ``pp/@v1/{robot}``: no wildcard matches a chunk that starts with ``@``, so protocol majors cannot mix. The
episode id is part of the key, so a late answer to an older episode cannot match.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Generic, TypeVar

from protocol import messages as m
from protocol.errors import ProtocolError

ROOT = "pp/@v1"
_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")

T = TypeVar("T")


class Priority(IntEnum):
    """Zenoh's priority classes, so that only ``zenoh_bus`` imports zenoh."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    DATA_HIGH = 4
    DATA = 5
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class Topic(Generic[T]):
    """One stream of one message type.

    Congestion control is DROP on every topic: a hung subscriber must never block the control path (with BLOCK a put was
    measured to wait 5 s). A subscriber holds at most ``keep`` undrained messages and drops older ones, so that data
    never ages in a queue.
    """

    name: str
    cls: type[T]
    priority: Priority
    keep: int


OBSERVATION = Topic("obs", m.Observation, Priority.DATA_HIGH, keep=1)
QUERY = Topic("query", m.Query, Priority.REAL_TIME, keep=8)
COGNITION = Topic("cognition", m.Cognition, Priority.INTERACTIVE_HIGH, keep=8)
STAMP = Topic("stamp", m.Stamp, Priority.DATA, keep=64)
INVOCATION = Topic("invocation", m.Invocation, Priority.REAL_TIME, keep=4)
CHUNK = Topic("chunk", m.ActionChunk, Priority.REAL_TIME, keep=8)
ACTION = Topic("action", m.Action, Priority.REAL_TIME, keep=64)
TICK = Topic("tick", m.Tick, Priority.DATA, keep=256)
SUBGOAL = Topic("subgoal", m.Subgoal, Priority.DATA, keep=64)
EVENT = Topic("event", m.Event, Priority.DATA, keep=256)
PHASE = Topic("phase", m.Phase, Priority.BACKGROUND, keep=64)
INFO = Topic("info", m.EpisodeInfo, Priority.DATA, keep=4)
RESULT = Topic("result", m.EpisodeResult, Priority.DATA, keep=4)
HEALTH = Topic("health", m.Health, Priority.BACKGROUND, keep=64)
SHADOW_COGNITION = Topic("shadow_cognition", m.Cognition, Priority.BACKGROUND, keep=8)
SHADOW_CHUNK = Topic("shadow_chunk", m.ActionChunk, Priority.BACKGROUND, keep=8)

SHADOW_OF = {"ponder-shadow": "ponder", "pounce-shadow": "pounce"}
"""Processes that answer what the servers are asked, on topics that only the log reads, and whom they stand behind."""

STREAMS: tuple[Topic[object], ...] = (  # type: ignore[assignment]
    OBSERVATION, QUERY, COGNITION, STAMP, INVOCATION, CHUNK, ACTION, TICK, SUBGOAL, EVENT, PHASE, INFO, RESULT, HEALTH,
    SHADOW_COGNITION, SHADOW_CHUNK,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Call:
    """One request and its reply, served by ``proc`` at ``pp/@v1/{robot}/@rpc/{proc}/{name}``."""

    name: str
    request: type
    reply: type


CONTRACT = Call("contract", m.ContractRequest, m.ContractReply)
OPEN = Call("open", m.OpenRequest, m.OpenReply)
CLOSE = Call("close", m.CloseRequest, m.CloseReply)
ACTIVE = Call("active", m.ActiveRequest, m.ActiveReply)
JOURNAL = Call("journal", m.JournalRequest, m.JournalReply)
TIME = Call("time", m.TimeRequest, m.TimeReply)
ENGAGE = Call("engage", m.EngageRequest, m.EngageReply)


def is_id(value: str) -> bool:
    """Whether ``value`` can be one chunk of a key."""
    return _ID.fullmatch(value) is not None


def checked_id(value: str, what: str) -> str:
    """Returns ``value`` if it can be one chunk of a key.

    Raises:
        ProtocolError: it is empty, too long, or has a character with a meaning in keys.
    """
    if not is_id(value):
        raise ProtocolError(
            f"{what} {value!r}: use 1 to 128 letters, digits, '_', '-' and '.', not starting with '-' or '.'"
        )
    return value


def stream_key(topic: Topic[T], robot: str, episode: str, proc: str) -> str:
    """Key of a message of ``topic``; '*' stands for any episode or process."""
    if topic is HEALTH or topic is PHASE:
        return f"{ROOT}/{robot}/{topic.name}/{proc}"
    return f"{ROOT}/{robot}/ep/{episode}/{topic.name}"


def episode_of(key: str) -> str:
    """The episode chunk of a stream key; "" if it has none."""
    parts = key.split("/")
    return parts[4] if len(parts) > 4 and parts[3] == "ep" else ""


def call_key(call: Call, robot: str, proc: str) -> str:
    return f"{ROOT}/{robot}/@rpc/{proc}/{call.name}"


def alive_key(robot: str, proc: str) -> str:
    """Key of a process's liveliness token, which disappears within the lease when it dies or freezes."""
    return f"{ROOT}/{robot}/alive/{proc}"


@lru_cache(maxsize=4096)  # LocalBus calls it for every subscription at every message
def matches(expression: str, key: str) -> bool:
    """Zenoh's rule for '*' (one chunk, never one that starts with '@'); '**' is not used here."""
    left, right = expression.split("/"), key.split("/")
    return len(left) == len(right) and all(
        a == b or (a == "*" and not b.startswith("@")) for a, b in zip(left, right, strict=True)
    )
