"""openpi's websocket: the server greets with metadata, then every message is an observation and its answer is a chunk.

The protocol has no episodes. Here one begins with a connection, with another prompt, and after ``{"reset": True}``, the
message that RoboMME's clients send. A client that plays the same prompt twice has to reset or connect anew in between:
otherwise PONDER takes both for one long episode.
"""

from __future__ import annotations

from typing import Any

from protocol.messages import Mode
from sim_client.gateway import reading
from sim_client.gateway.arrays import pack
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Packet, Step, Terms

CAMERAS = {"front": "observation/image", "wrist": "observation/wrist_image"}
STATE_KEY = "observation/state"
PROMPT_KEY = "prompt"


class OpenpiDialect:
    """Works with ``openpi-client`` 0.1.2 as published. An error is a text frame, which that client raises."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._instruction: str | None = None

    def greeting(self) -> bytes:
        return pack(metadata(self._terms), "openpi")

    def read(self, packet: Packet) -> ClientRequest:
        message = reading.message(packet)
        if message.get("reset"):
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
        )
        self._instruction = instruction
        return ClientRequest(step)

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        return pack(actions_of(answer), "openpi")

    def refuse(self, sentence: str) -> str:
        return sentence


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
    }


def actions_of(answer: Answer) -> dict[str, Any]:
    """The rows, and beside them where they come from: `Answer.told`, and the ladder's rung of each."""
    return {"actions": answer.rows_NA, "levels": answer.level_names, **answer.told}
