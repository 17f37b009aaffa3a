"""The evaluator of RoboMME's policy repository: ``reset``, ``add_buffer``, ``infer``, over openpi's websocket framing.

An episode begins with a reset. Before each ``infer`` the client sends what it has seen since the last one, front camera
only: first the demonstration and the current observation, later one observation per played row. The wrist's pictures
come with ``infer`` alone, so the ticks between two requests have the wrist's last one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_client.gateway import reading
from sim_client.gateway.arrays import pack
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Frames, Observed, Packet, Refused, Step, Terms
from sim_client.gateway.openpi import PROMPT_KEY, actions_of, metadata

ROWS = 16
"""Rows of each answer that the evaluator plays."""


class MmeVlaDialect:
    """Works with ``examples/robomme/eval.py``, with and without its history. Subgoals that it sends are ignored."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._buffer: list[Observed] = []
        self._demo: list[Frames] = []
        self._last: Frames | None = None

    def greeting(self) -> bytes:
        return pack(metadata(self._terms), "openpi")

    def read(self, packet: Packet) -> ClientRequest:
        message = reading.message(packet)
        if reading.truth(message.get("reset", False), "reset"):
            self._buffer, self._demo, self._last = [], [], None
            return ClientRequest(Finish(is_reset=True), reply=pack({"reset_finished": True}, "openpi"))
        if reading.truth(message.get("add_buffer", False), "add_buffer"):
            self._fill(message)
            return ClientRequest(None, reply=pack({"add_buffer_finished": True}, "openpi"))
        return ClientRequest(self._step(message))

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        return pack(actions_of(answer), "openpi")

    def refuse(self, sentence: str) -> str:
        return sentence

    def _fill(self, message: Mapping[Any, Any]) -> None:
        """Keeps what was seen. The last observation comes again with ``infer``."""
        why = "what was seen since the last call"
        images = reading.field(message, "images", why)
        states = reading.listed(reading.field(message, "state", why), "state")
        shape: tuple[int, ...] = images.shape if isinstance(images, np.ndarray) else ()
        if len(shape) != 5 or shape[0] == 0 or shape[1] != 1 or len(states) != shape[0]:
            raise Refused(
                f"images, state: expected (T, 1, height, width, 3) and T states of {self._terms.num_proprio} numbers, "
                f"came {shape or reading.shown(images)} and {len(states)}"
            )
        front = next(iter(self._terms.cameras))
        seen = [{front: reading.picture(frame, "images")} for frame in images[:, 0]]
        if self._last is None:
            start = message.get("exec_start_idx", 0)
            if not isinstance(start, int | np.integer) or not 0 <= start < len(seen):
                expected = f"0 to {len(seen) - 1}, the last observation"
                raise Refused(f"exec_start_idx: expected {expected}, came {reading.shown(start)}")
            self._demo, self._buffer = list(seen[:start]), []
            return
        if len(seen) != self._terms.rows:
            raise Refused(
                f"images: expected {self._terms.rows}, one for each row that was given last time, came {len(seen)}. If "
                f"the client plays that many rows of each answer, start pp-gateway with --rows {len(seen)}."
            )
        numbers = [reading.numbers(state, "state", self._terms.num_proprio) for state in states]
        self._buffer = [Observed({**self._last, **frames}, state) for frames, state in zip(seen, numbers, strict=True)]

    def _step(self, message: Mapping[Any, Any]) -> Step:
        frames = dict(reading.frames(message, self._terms.cameras))
        state = reading.field(message, self._terms.state_key, "the measured joints")
        step = Step(
            instruction=reading.text(message, PROMPT_KEY),
            frames=frames,
            state=reading.numbers(state, self._terms.state_key, self._terms.num_proprio),
            begins=self._last is None,
            demo=self._demo,
            since=self._buffer[:-1],
        )
        self._buffer, self._demo, self._last = [], [], frames
        return step
