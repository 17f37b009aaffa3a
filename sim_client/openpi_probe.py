"""``python -m sim_client.openpi_probe HOST:PORT droid 20``: times an openpi policy server, as its client does.

It prints one JSON object. It is a process of its own, because that client waits without a limit for a silent server.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np

RobotName = Literal["droid", "libero", "aloha"]
NUM_WARM = 3  # a compiled policy's first answers take minutes


def observation(robot: str, file: Path | None = None) -> dict[str, Any]:
    """An observation as policies of this robot read it, or the arrays of an .npz file; black pictures take as long."""
    if file is not None:
        with np.load(file, allow_pickle=False) as arrays:
            return {key: arrays[key].item() if arrays[key].dtype.kind == "U" else arrays[key] for key in arrays}
    image = np.zeros((224, 224, 3), np.uint8)
    if robot == "droid":
        found: dict[str, Any] = {
            "observation/exterior_image_1_left": image,
            "observation/wrist_image_left": image,
            "observation/joint_position": np.zeros(7, np.float32),
            "observation/gripper_position": np.zeros(1, np.float32),
        }
    elif robot == "libero":
        state = np.zeros(8, np.float32)
        found = {"observation/image": image, "observation/wrist_image": image, "observation/state": state}
    else:
        cameras = ("cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist")
        found = {"state": np.zeros(14, np.float32), "images": dict.fromkeys(cameras, image.transpose(2, 0, 1))}
    return found | {"prompt": "pick up the cube"}


def timed(infer: Any, seen: dict[str, Any], num_answers: int) -> dict[str, Any]:
    """Shape of the answers and their durations in ns, without the first few.

    Raises:
        KeyError, ValueError: an answer has no (H, A) "actions".
    """
    durations_ns, shape = [], (0, 0)
    for _ in range(NUM_WARM + num_answers):
        start_ns = time.monotonic_ns()
        answer = infer(seen)
        durations_ns.append(time.monotonic_ns() - start_ns)
        shape = np.shape(answer["actions"])
    if len(shape) != 2:
        raise ValueError(f"expected actions (H, A), came {shape}")
    return {"durations_ns": durations_ns[NUM_WARM:], "horizon": shape[0], "action_dim": shape[1]}


def main(argv: list[str]) -> int:
    address, robot, count, *file = argv
    try:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy

        host, _, port = address.rpartition(":")
        client = WebsocketClientPolicy(host, int(port))
        found = timed(client.infer, observation(robot, *map(Path, file)), int(count))
    except Exception as error:  # whatever a foreign server may do
        sys.stdout.write(json.dumps({"error": f"{type(error).__name__}: {error}".strip()[-500:]}) + "\n")
        return 1
    sys.stdout.write(json.dumps(found) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
