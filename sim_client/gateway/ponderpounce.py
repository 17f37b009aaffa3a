"""The dialect of ``ponderpounce-client``, for a robot's own program: it says what the robot measured and when, and gets
each tick's command with its rung of the ladder and its deadline.

Every message is a msgpack map with ``kind`` and ``seq``; its answer has the same ``seq``. All instants are this host's
monotonic clock in ns; a client on another host measures the offset with ``time``. Live only: an observation is answered
with the first command after the last one that this client was told of, so a loop without a timer of its own keeps
the schedule's rate, and a late one gets the newest command.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import msgpack

from clock.timebase import NS_PER_S
from protocol.messages import RobotState, TaskStatus
from sim_client.gateway import reading
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Packet, Refused, Step, Terms, Trial

VERSION = 1
STATE_KEY = "state"
EXPIRY_TICKS = 3
"""Ticks after its deadline at which a command expires: the robot's own watchdog stops it unless another has come."""
MAX_TEXT = 500
_KINDS = "time, begin, observe or end"
_STATES = {state.name.lower(): state for state in RobotState if state}


class PonderpounceDialect:
    """The robot's program begins and ends episodes itself; a robot that was stopped waits for a person."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._seq = 0
        self._instruction = ""
        self._told_tick = -1

    def greeting(self) -> bytes:
        terms, robot = self._terms, self._terms.robot
        return _message(
            "welcome",
            0,
            version=VERSION,
            server=f"ponderpounce {terms.version}",
            control_hz=terms.control_hz,
            cameras=list(terms.cameras.values()),
            robot={
                "name": robot.name,
                "num_proprio": robot.num_proprio,
                "is_simulated": robot.is_simulated,
                "command_low": robot.command_low.tolist(),
                "command_high": robot.command_high.tolist(),
                "max_step": robot.max_step.tolist(),
                "dimensions": [
                    {
                        "name": each.name,
                        "kind": each.kind.name.lower(),
                        "at_stop": each.at_stop.name.lower(),
                        "unit": each.unit,
                        "state": each.state_index,
                    }
                    for each in robot.dimensions
                ],
                "stop_ticks": robot.stop_ticks,
                "at_exit": robot.at_exit.name.lower(),
                "home": robot.home.tolist(),
            },
        )

    def read(self, packet: Packet) -> ClientRequest:
        self._seq = 0
        message = reading.message(packet)
        seq = message.get("seq")
        if type(seq) is not int or not 0 <= seq < 1 << 63:
            raise Refused(f"seq: expected the number of this message, came {reading.shown(seq)}")
        self._seq = seq
        kind = reading.word(message.get("kind"), "kind", _KINDS)
        if kind == "time":
            return ClientRequest(None, seq, reply=_message("time", seq, now_ns=time.monotonic_ns()))
        if kind == "begin":
            is_dry = reading.truth(message.get("dry_run", False), "dry_run")
            self._instruction, self._told_tick = reading.text(message, "instruction"), -1
            trial = Trial(speed=_speed(message), is_dry=is_dry)
            return ClientRequest(self._step(message, trial), seq, reply=_message("begun", seq))
        if kind == "observe":
            return ClientRequest(self._step(message, None), seq)
        if kind == "end":
            return ClientRequest(_outcome(message), seq, reply=_message("ended", seq))
        raise Refused(f"kind: expected {_KINDS}, came {reading.shown(kind)}")

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        self._told_tick = answer.tick
        return _message(
            "command",
            asked.seq,
            values=answer.rows_NA[0].tolist(),
            level=answer.levels[0].name,
            deadline_ns=answer.deadline_ns,
            expires_ns=answer.deadline_ns + EXPIRY_TICKS * NS_PER_S // self._terms.control_hz,
            **answer.told,
        )

    def refuse(self, sentence: str) -> bytes:
        return _message("refused", self._seq, why=sentence)

    def _captured_ns(self, message: Mapping[Any, Any]) -> Mapping[str, int]:
        """Instants of the pictures by our cameras' names; a client may leave out any."""
        given = message.get("captured_ns", {})
        if not isinstance(given, Mapping):
            raise Refused(f"captured_ns: expected instants by camera, came {type(given).__name__}")
        return {name: _instant(given, key) for name, key in self._terms.cameras.items() if key in given}

    def _step(self, message: Mapping[Any, Any], trial: Trial | None) -> Step:
        key, states = self._terms.state_key, ", ".join(_STATES)
        said = reading.word(message.get("robot_state", "ok"), "robot_state", states)
        if said not in _STATES:
            raise Refused(f"robot_state: expected {states}, came {reading.shown(said)}")
        pictures = reading.field(message, "images", "pictures by camera")
        if not isinstance(pictures, Mapping):
            raise Refused(f"images: expected pictures by camera, came {type(pictures).__name__}")
        return Step(
            instruction=self._instruction,
            frames=reading.frames(pictures, self._terms.cameras),
            state=reading.numbers(reading.field(message, key, "the measured joints"), key, self._terms.num_proprio),
            begins=trial is not None,
            task=reading.word(message.get("task", ""), "task"),
            taken_ns=_instant(message, "state_ns"),
            captured_ns=self._captured_ns(message),
            robot_state=_STATES[said],
            robot_text=reading.word(message.get("robot_text", ""), "robot_text")[:MAX_TEXT],
            after_tick=self._told_tick,
            trial=trial,
        )


def _instant(message: Mapping[Any, Any], key: str) -> int:
    value = reading.field(message, key, "an instant on this host's monotonic clock")
    if type(value) is not int or abs(value) >= 1 << 62:
        raise Refused(f"{key}: expected nanoseconds, came {reading.shown(value)}")
    return value


def _speed(message: Mapping[Any, Any]) -> float:
    value = message.get("speed", 1.0)
    if type(value) not in (int, float) or not 0.1 <= value <= 1:
        raise Refused(f"speed: expected 0.1 to 1, the share of the robot's step limits, came {reading.shown(value)}")
    return float(value)


def _outcome(message: Mapping[Any, Any]) -> Finish:
    success, reason = message.get("success"), reading.word(message.get("reason", ""), "reason")[:MAX_TEXT]
    if success is None:
        return Finish(reason=reason or "the robot's program ended it")
    status = TaskStatus.SUCCESS if reading.truth(success, "success") else TaskStatus.FAIL
    return Finish(status=status, reason=reason or "says the robot's program")


def _message(kind: str, seq: int, **values: Any) -> bytes:
    return bytes(msgpack.packb({"kind": kind, "seq": seq, **values}))
