"""The conversation with ``pp-gateway --dialect ponderpounce``, in plain blocking calls.

The gateway runs on the robot's computer or near it; a thread of websockets is the only one here. Instants are this
computer's ``time.monotonic_ns()``; the gateway's clock is compared with it once, when the conversation begins.
"""

from __future__ import annotations

import contextlib
import inspect
import time
from dataclasses import dataclass, field
from typing import Any, Mapping

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

VERSION = 1
ROBOT_STATES = ("ok", "user_stop", "protective_stop", "fault", "torque_off")
_NUM_EXCHANGES = 8
_CLOSE_S = 1.0  # a gateway that is frozen says no goodbye
_JPEG_MAGIC = b"\xff\xd8"


class Refused(Exception):
    """The gateway does not take a request, and says why. The next one may be taken."""


class Lost(Exception):
    """The gateway does not answer: it died, is frozen, or cannot be reached."""


@dataclass
class Observation:
    """What a robot measured.

    ``state``: the joints, in the order and units of the robot's file. ``images``: (height, width, 3) uint8 RGB by the
    camera's name, or a JPEG's bytes. ``state_ns`` and ``captured_ns``, by camera: when that was; a picture without
    an instant is as old as the state. ``robot_state``: one of ROBOT_STATES; anything but ok stops the schedule
    until a person engages it, with the robot's own words in ``robot_text``.
    """

    state: Any
    images: Mapping[str, Any]
    state_ns: int = field(default_factory=time.monotonic_ns)
    captured_ns: Mapping[str, int] = field(default_factory=dict)
    robot_state: str = "ok"
    robot_text: str = ""


@dataclass(frozen=True)
class Command:
    """One tick's command.

    ``values``: (action_dim,) float32, within the robot's limits. ``level``: PLAY or STALE for a policy's row, HOLD,
    DECELERATE or STOPPED where there is none. ``deadline_ns``: the tick's. ``expires_ns``: when a robot that got no
    newer command has to stop by itself. ``subgoal``: PONDER's newest, "" if it has none yet, with its age and that of
    the cognition behind ``values``, in seconds of the schedule. ``gate_score``: the probability of a transition that
    PONDER found with that cognition; None if it has no gate or there is no cognition yet.
    """

    tick: int
    values: np.ndarray
    level: str
    deadline_ns: int
    expires_ns: int
    subgoal: str = ""
    subgoal_age_s: float = 0.0
    cognition_age_s: float = 0.0
    gate_score: float | None = None

    @property
    def is_playing(self) -> bool:
        return self.level in ("PLAY", "STALE")


class Client:
    """One connection, for one robot and one episode after the other.

    Args:
        url: of the gateway.
        api_key: the word in the gateway's --api-key-file.
        patience_s: longest wait for a connection, for servers to open an episode, and for its first command.
        silence_s: longest wait for any further answer: a busy computer stands still for a second and is not dead. The
            robot's own watchdog does not wait for it.

    Raises:
        Lost: nobody answers there.
        Refused: the gateway wants a key, or speaks another version.
    """

    def __init__(
        self, url: str = "ws://127.0.0.1:8000", api_key: str = "", patience_s: float = 150.0, silence_s: float = 5.0
    ) -> None:
        self._url, self._patience_s, self._silence_s = url, patience_s, silence_s
        self._seq, self._has_command = 0, False
        self._opened = contextlib.ExitStack()
        options: dict[str, Any] = {"compression": None, "max_size": None}
        options |= {"open_timeout": min(10.0, patience_s), "close_timeout": _CLOSE_S}
        if "proxy" in inspect.signature(connect).parameters:  # a robot is not reached through a proxy for the web
            options["proxy"] = None
        if api_key:
            options["additional_headers"] = {"Authorization": "Api-Key " + api_key}
        try:
            self._socket = self._opened.enter_context(connect(url, **options))
        except InvalidStatus as error:
            raise Refused(f"{url} refuses the connection: {error}") from None
        except (OSError, TimeoutError, EOFError, ConnectionClosed) as error:
            raise Lost(f"{url}: expected pp-gateway --dialect ponderpounce, came {error}") from None
        self.welcome = self._next("welcome", 0, patience_s)
        if self.welcome.get("version") != VERSION:
            raise Refused(f"expected version {VERSION} of the dialect, came {self.welcome.get('version')!r}")
        self.period_ns = 1_000_000_000 // int(self.welcome["control_hz"])
        self._offset_ns, self.clock_bound_ns = self._compare_clocks()

    def begin(
        self, observation: Observation, instruction: str, *, task: str = "", speed: float = 1.0, dry_run: bool = False
    ) -> None:
        """Opens an episode with the servers, which may take its time; nothing is commanded yet.

        Args:
            observation: what is seen before it; its pictures' size is the episode's.
            speed: share of the robot's step limits, 0.1 to 1.
            dry_run: nothing will be sent to the robot; the log says so.

        Raises:
            Refused, Lost: the servers do not take it, or are not there.
        """
        self._has_command = False
        said = dict(self._spelled(observation), instruction=instruction, task=task, speed=speed, dry_run=dry_run)
        self._ask("begin", "begun", self._patience_s, said)

    def step(self, observation: Observation) -> Command:
        """Sends what is measured now; returns the command of the next tick, when it is due.

        A loop of nothing else runs at the schedule's rate; one that is late gets the newest command.

        Raises:
            Refused: the observation cannot be used, or the episode is over.
            Lost: no answer within ``silence_s``; the first command may take ``patience_s``.
        """
        longest_s = self._silence_s if self._has_command else self._patience_s
        told = self._ask("observe", "command", longest_s, self._spelled(observation))
        self._has_command = True
        return Command(
            tick=told["tick"],
            values=np.array(told["values"], np.float32),
            level=told["level"],
            deadline_ns=told["deadline_ns"] - self._offset_ns,
            expires_ns=told["expires_ns"] - self._offset_ns,
            subgoal=told["subgoal"],
            subgoal_age_s=told["subgoal_age_s"],
            cognition_age_s=told["cognition_age_s"],
            gate_score=told.get("gate_score"),
        )

    def end(self, success: bool | None = None, reason: str = "") -> None:
        """Ends the episode and its log. ``success``: None if nobody knows."""
        self._ask("end", "ended", self._patience_s, {"success": success, "reason": reason})

    def close(self) -> None:
        """Leaves; an open episode ends."""
        self._opened.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def _spelled(self, observation: Observation) -> dict[str, Any]:
        ours = self._offset_ns
        return {
            "state": np.asarray(observation.state, np.float64).ravel().tolist(),
            "state_ns": observation.state_ns + ours,
            "images": {name: _picture(image, name) for name, image in observation.images.items()},
            "captured_ns": {name: instant + ours for name, instant in observation.captured_ns.items()},
            "robot_state": observation.robot_state,
            "robot_text": observation.robot_text,
        }

    def _compare_clocks(self) -> tuple[int, int]:
        """The gateway's clock minus ours in ns, and what it is uncertain by: of a few exchanges the shortest."""
        found = []
        for _ in range(_NUM_EXCHANGES):
            left_ns = time.monotonic_ns()
            told_ns = self._ask("time", "time", self._patience_s, {})["now_ns"]
            back_ns = time.monotonic_ns()
            found.append(((back_ns - left_ns) // 2, told_ns - (left_ns + back_ns) // 2))
        bound_ns, offset_ns = min(found)
        # On one computer it is the same clock, and what was measured is the way there.
        return (0 if abs(offset_ns) <= bound_ns else offset_ns), bound_ns

    def _ask(self, kind: str, expected: str, longest_s: float, values: dict[str, Any]) -> dict[str, Any]:
        self._seq += 1
        try:
            self._socket.send(msgpack.packb(dict(values, kind=kind, seq=self._seq)))
        except ConnectionClosed as error:
            raise Lost(f"{self._url} left: {error}") from None
        return self._next(expected, self._seq, longest_s)

    def _next(self, expected: str, seq: int, longest_s: float) -> dict[str, Any]:
        """The answer to message ``seq``; late ones to earlier messages are left out."""
        until_s = time.monotonic() + longest_s
        while True:
            try:
                packet = self._socket.recv(timeout=max(0.0, until_s - time.monotonic()))
            except TimeoutError:
                raise Lost(f"{self._url}: no answer within {longest_s:g} s") from None
            except ConnectionClosed as error:
                raise Lost(f"{self._url} left: {error}") from None
            told = msgpack.unpackb(packet) if isinstance(packet, bytes) else {}
            if not isinstance(told, dict) or "kind" not in told:
                raise Refused(f"{self._url}: expected the dialect ponderpounce; is it pp-gateway's?")
            if told["seq"] != seq:
                continue
            if told["kind"] == "refused":
                raise Refused(told["why"])
            if told["kind"] != expected:
                raise Refused("{}: expected {}, came {}".format(self._url, expected, told["kind"]))
            return told


def _picture(image: Any, name: str) -> dict[Any, Any]:
    """A picture as it travels: pixels, or a JPEG with its size."""
    if isinstance(image, bytes):
        height, width = _jpeg_size(image, name)
        return {"__image__": True, "format": "jpeg", "data": image, "shape": [height, width, 3]}
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        came = f"{image.shape} of {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name}: expected (height, width, 3) of uint8, RGB, or a JPEG's bytes, came {came}")
    return {"__ndarray__": True, "data": image.tobytes(), "dtype": "|u1", "shape": list(image.shape)}


def _jpeg_size(data: bytes, name: str) -> tuple[int, int]:
    """Height and width in a JPEG's frame header. Raises ValueError if there is none."""
    at = 2 if data[:2] == _JPEG_MAGIC else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + length
    raise ValueError(f"{name}: expected a JPEG, came {len(data)} bytes of something else")
