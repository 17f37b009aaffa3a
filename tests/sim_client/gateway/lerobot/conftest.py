"""An arm of two joints and a gripper as LeRobot's remote inference knows it, and what its client would send."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

from protocol import messages as m
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from sim_client.gateway.exchange import Terms

PX, ROWS = 4, 5
JOINTS = ("pan.pos", "lift.pos", "gripper.pos")
STATE, FRONT, WRIST = "observation.state", "observation.images.front", "observation.images.wrist"
MAPPING = PolicyMapping(
    name="arm",
    rate_hz=20,
    play_hz=20,
    horizon=ROWS,
    num_proprio=3,
    num_commands=3,
    prompt=Prompt(key=("task",)),
    cameras=(
        Camera(camera="front", key=(FRONT,), size_px=(PX, PX)), Camera(camera="wrist", key=(WRIST,), size_px=(PX, PX)),
    ),
    state=(
        Numbers(key=(STATE,), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=(STATE,), columns=(2,), dims=(2,), scale=0.01),
    ),
    actions=(
        Numbers(key=("action",), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=("action",), columns=(2,), dims=(2,), scale=0.01, kind="gripper"),
    ),
    names={(STATE,): JOINTS, ("action",): JOINTS},
)  # fmt: skip
IDS = (f"{number:032x}" for number in itertools.count(1))


class Wire:
    """What a client of LeRobot's sends, message by message."""

    mapping = MAPPING

    @staticmethod
    def tensor(array: np.ndarray) -> dict[str, Any]:
        return {
            "__lerobot_type__": "tensor", "dtype": array.dtype.name, "shape": list(array.shape), "endianness": "little",
            "data": array.tobytes(),
        }  # fmt: skip

    @staticmethod
    def picture(shade: int) -> dict[str, Any]:
        return {
            "__lerobot_type__": "rgb", "encoding": "raw", "shape": [PX, PX, 3], "dtype": "uint8",
            "channel_order": "RGB", "data": bytes([shade % 256]) * (PX * PX * 3),
        }  # fmt: skip

    @staticmethod
    def enveloped(kind: str, body: Any, **ids: Any) -> bytes:
        header = {"instance_id": "", "session_id": "", "request_id": next(IDS), "generation": 0}
        return bytes(msgpack.packb({"version": 1, "message_type": kind, "body": body, **(header | ids)}))

    @staticmethod
    def observation(artifact: str, sequence: int, **changes: Any) -> dict[str, Any]:
        degrees = np.array([90.0, -45.0, 50.0], np.float32)
        body = {
            "sequence": sequence, "artifact_identity": artifact, "observation_id": f"o{sequence}",
            "capture_time": 12.25 + sequence, "task": "put the cube in the bin", "task_version": 0,
            "features": {STATE: Wire.tensor(degrees), FRONT: Wire.picture(sequence), WRIST: Wire.picture(7)},
            "delay": 0, "model_continuation": None, "canonical_continuation": None,
            "cursor": sequence, "observation_cursor": sequence,
        }  # fmt: skip
        return body | changes


@pytest.fixture(scope="session")
def wire() -> type[Wire]:
    return Wire


@pytest.fixture(scope="module")
def terms(terms_with: Callable[..., Terms]) -> Terms:
    return terms_with(mode=m.Mode.REALTIME, rows=ROWS, mapping=MAPPING)
