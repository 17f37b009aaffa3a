"""A fake arm, in a process of its own like a robot's controller: it goes on when the program that drives it is dead.

    python -m ponderpounce_client.fake_arm 127.0.0.1:9100

Seven joints and a gripper, in the units of the Panda. It answers JSON datagrams, late or not at all if it is told so;
it has an emergency stop, and a hand that moves the stopped arm away.
"""

from __future__ import annotations

import json
import socket
import sys
import time
from typing import Any

import numpy as np

HOME = [0.0, 0.3927, 0.0, -1.9635, 0.0, 2.3562, 0.7854]
_OPEN_M = 0.04
_ANSWER_S = 0.05
_MAX_BYTES = 65_000


def address_of(text: str) -> tuple[str, int]:
    """HOST:PORT as a pair. Raises ValueError."""
    host, _, port = text.rpartition(":")
    return host, int(port)


class Controller:
    """What the process answers. Servos are there at once; a stopped arm takes no command until ``reset``."""

    def __init__(self) -> None:
        self.joints, self.finger_m = np.array(HOME), _OPEN_M
        self.state, self.text = "ok", ""
        self.delay_s = 0.0
        self.stalled_until_s = 0.0
        self.moves: list[list[float]] = []  # instant in ns, largest movement of a joint
        self.stopped_ns = 0

    def answer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """One request's reply; ``error`` says why there is none."""
        handler = getattr(self, "_on_" + str(asked.get("op")), None)
        if handler is None:
            return {"error": f"unknown op {asked.get('op')!r}"}
        return handler(asked) or {}

    def _on_read(self, asked: dict[str, Any]) -> dict[str, Any]:
        return {"state": [*self.joints.tolist(), self.finger_m], "says": self.state, "text": self.text}

    def _on_move(self, asked: dict[str, Any]) -> dict[str, Any] | None:
        if self.state != "ok":
            return {"error": f"no motion: {self.state}"}
        values = np.array(asked["values"], float)
        self.moves.append([float(time.monotonic_ns()), float(np.abs(values[:7] - self.joints).max())])
        self.joints, self.finger_m = values[:7], _OPEN_M * float(np.clip((values[7] + 1) / 2, 0, 1))
        return None

    def _on_stop(self, asked: dict[str, Any]) -> None:
        self.state, self.text = str(asked.get("says", "protective_stop")), str(asked.get("text", ""))
        self.stopped_ns = time.monotonic_ns()

    def _on_release(self, asked: dict[str, Any]) -> None:
        self.state, self.text = "torque_off", ""

    def _on_reset(self, asked: dict[str, Any]) -> None:
        self.state, self.text = "ok", ""

    def _on_displace(self, asked: dict[str, Any]) -> None:
        self.joints = self.joints + float(asked["by"])

    def _on_delay(self, asked: dict[str, Any]) -> None:
        self.delay_s = float(asked["s"])

    def _on_stall(self, asked: dict[str, Any]) -> None:
        self.stalled_until_s = time.monotonic() + float(asked["s"])

    def _on_history(self, asked: dict[str, Any]) -> dict[str, Any]:
        return {"moves": self.moves[-400:], "num_moves": len(self.moves), "stopped_ns": self.stopped_ns}


def serve(address: tuple[str, int]) -> None:
    """Answers for ever."""
    controller = Controller()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(address)
        while True:
            data, peer = box.recvfrom(_MAX_BYTES)
            if time.monotonic() < controller.stalled_until_s:
                continue
            time.sleep(controller.delay_s)
            asked = json.loads(data)
            box.sendto(json.dumps(dict(controller.answer(asked), number=asked["number"])).encode(), peer)


class FakeArm:
    """A driver of the fake arm. A call that is not answered within ``answer_s``, a tick, raises OSError."""

    def __init__(self, address: str, answer_s: float = _ANSWER_S) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(answer_s)
        self._socket.connect(address_of(address))
        self._number = 0

    def close(self) -> None:
        self._socket.close()

    def call(self, op: str, **values: Any) -> dict[str, Any]:
        """The controller's reply. Raises OSError: it does not answer."""
        self._number += 1
        self._socket.send(json.dumps(dict(values, op=op, number=self._number)).encode())
        while True:
            reply = json.loads(self._socket.recv(_MAX_BYTES))
            if reply["number"] == self._number:  # and not a late one
                return dict(reply)


if __name__ == "__main__":
    serve(address_of(sys.argv[1]))
