"""openpi's websocket: the server greets with metadata, then every message is an observation and its answer is a chunk.

The protocol has no episodes. Here one begins with a connection, with another prompt, and after ``{"reset": True}``, the
message that RoboMME's clients send. A client that plays the same prompt twice has to reset or connect anew in between:
otherwise PONDER takes both for one long episode.

One thing is ours: the first observation of an episode may bring a conditioning video, ``demonstration``, a list of
pictures, with ``demonstration_hz``, its rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from protocol.messages import Mode
from sim_client.gateway import reading
from sim_client.gateway.arrays import pack
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Frames, Packet, Refused, Step, Terms

CAMERAS = {"front": "observation/image", "wrist": "observation/wrist_image"}
STATE_KEY = "observation/state"
PROMPT_KEY = "prompt"
MAX_DEMO_HZ = 120
DEMO_KEY, DEMO_HZ_KEY = "demonstration", "demonstration_hz"


class OpenpiDialect:
    """Works with ``openpi-client`` 0.1.2 as published. An error is a text frame, which that client raises."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._instruction: str | None = None

    def greeting(self) -> bytes:
        return pack(metadata(self._terms), "openpi")

    def read(self, packet: Packet) -> ClientRequest:
        message = reading.message(packet)
        if reading.truth(message.get("reset", False), "reset"):
            self._instruction = None
            return ClientRequest(Finish(is_reset=True), reply=pack({"reset_finished": True}, "openpi"))
        instruction = reading.text(message, PROMPT_KEY)
        state = reading.field(message, self._terms.state_key, "the measured joints")
        step = Step(
            instruction=instruction,
            frames=reading.frames(message, self._terms.cameras),
            state=reading.numbers(state, self._terms.state_key, self._terms.num_proprio),
            begins=self._instruction not in (None, instruction),
            may_begin=True,
            demo=_demonstration(message, self._terms),
            demo_hz=_rate(message),
        )
        self._instruction = instruction
        return ClientRequest(step)

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        return pack(actions_of(answer), "openpi")

    def refuse(self, sentence: str) -> str:
        return sentence


def _demonstration(message: Mapping[Any, Any], terms: Terms) -> Sequence[Frames]:
    """The conditioning video; every camera of ours shows it, and PONDER reads as many as its contract says."""
    if DEMO_KEY not in message:
        return ()
    return reading.videos(dict.fromkeys(terms.cameras, reading.listed(message[DEMO_KEY], DEMO_KEY)))


def _rate(message: Mapping[Any, Any]) -> int:
    """Frames per second of the conditioning video; 0: the control rate. Raises Refused if it is none."""
    rate_hz = message.get(DEMO_HZ_KEY, 0)
    if not isinstance(rate_hz, int | np.integer) or not 0 <= rate_hz <= MAX_DEMO_HZ:
        raise Refused(f"{DEMO_HZ_KEY}: expected frames per second, 1 to {MAX_DEMO_HZ}, came {reading.shown(rate_hz)}")
    return int(rate_hz)


def metadata(terms: Terms) -> dict[str, Any]:
    """Metadata of the server for its clients."""
    return {
        "server": f"ponderpounce {terms.version}",
        "mode": "live" if terms.mode == Mode.REALTIME else "lockstep",
        "control_hz": terms.control_hz,
        "rows": terms.rows,
        "action": "absolute targets, one row per control tick",
        "cameras": {name: key for name, key in terms.cameras.items() if key},
        "state": terms.state_key,
        "robot": {
            "name": terms.robot.name,
            "num_proprio": terms.num_proprio,
            "dimensions": [each.name for each in terms.robot.dimensions],
        },
    }


def actions_of(answer: Answer) -> dict[str, Any]:
    """The rows, and beside them where they come from: `Answer.told`, and the ladder's rung of each."""
    return {"actions": answer.rows_NA, "levels": answer.level_names, **answer.told}
