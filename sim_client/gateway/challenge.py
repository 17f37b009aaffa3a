"""The RoboMME challenge's policy protocol: ``reset`` and ``infer``, over openpi's websocket framing or over HTTP.

An episode begins with a reset and an ``infer`` with ``is_first_step``; its lists hold the conditioning video and, last,
the current observation. Later calls hold all observations since the last one, one per played row, so a client that
plays fewer rows than it received is detected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from protocol.messages import Floats
from sim_client.gateway import reading
from sim_client.gateway.arrays import pack
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Observed, Packet, Refused, Step, Terms
from sim_client.gateway.openpi import actions_of, metadata

CAMERAS = {"front": "front_rgb_list", "wrist": "wrist_rgb_list"}
JOINTS_KEY, GRIPPER_KEY = "joint_state_list", "gripper_state_list"
ROWS = 20
"""Rows of each answer that the challenge's runner usually plays."""
RESET_FINISHED = {"reset_finished": True}


class ChallengeDialect:
    """Joint-angle actions, the challenge's default. Depth and camera parameters are accepted and ignored."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms

    def greeting(self) -> bytes:
        return pack(metadata(self._terms), "openpi")

    def read(self, packet: Packet) -> ClientRequest:
        message = reading.message(packet)
        if reading.truth(message.get("reset", False), "reset"):
            return ClientRequest(Finish(is_reset=True), reply=pack(RESET_FINISHED, "openpi"))
        begins = reading.truth(reading.field(message, "is_first_step", "whether an episode begins"), "is_first_step")
        lists = {name: _list(message, key) for name, key in self._terms.cameras.items()}
        seen = reading.videos(lists)
        if len(seen) == 0:
            raise Refused("front_rgb_list: expected at least what is seen now, came an empty list")
        if not begins and len(seen) != self._terms.rows:
            raise Refused(
                f"expected {self._terms.rows} observations, one for each row that was given last time, came "
                f"{len(seen)}. If the client plays that many rows of each answer, start pp-gateway with "
                f"--rows {len(seen)}."
            )
        instruction = reading.text(message, "task_goal")
        if begins:  # the states of the video are ignored
            return ClientRequest(
                Step(
                    instruction=instruction,
                    frames=seen[-1],
                    state=_states(message, 1, self._terms.num_proprio)[0],
                    begins=True,
                    demo=seen[:-1],
                )
            )
        states = _states(message, len(seen), self._terms.num_proprio)
        since = tuple(Observed(frames, state) for frames, state in zip(seen[:-1], states, strict=False))
        return ClientRequest(
            Step(instruction=instruction, frames=seen[-1], state=states[-1], begins=False, since=since)
        )

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        return pack(actions_of(answer), "openpi")

    def refuse(self, sentence: str) -> str:
        return sentence


def _states(message: Mapping[Any, Any], count: int, num_proprio: int) -> list[Floats]:
    """The joints and one finger of the last ``count`` observations.

    The other finger mirrors the first, and a stick has none: 0.
    """
    joints, fingers = (_list(message, key)[-count:] for key in (JOINTS_KEY, GRIPPER_KEY))
    if len(joints) != count or len(fingers) != count:
        raise Refused(f"{JOINTS_KEY}, {GRIPPER_KEY}: expected {count}, came {len(joints)} and {len(fingers)}")
    name = f"{JOINTS_KEY} and one finger"
    return [
        reading.numbers(
            [*reading.vector(joint, JOINTS_KEY), *[*reading.vector(finger, GRIPPER_KEY), 0.0][:1]], name, num_proprio
        )
        for joint, finger in zip(joints, fingers, strict=True)
    ]


def _list(message: Mapping[Any, Any], key: str) -> Sequence[Any]:
    return reading.listed(reading.field(message, key, "all that was seen since the last call"), key)
