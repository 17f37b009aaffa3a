"""The peer's half of ``task_speed``: robosuite's own ``env.step`` on one core. Prints JSON; imports nothing of ours.

It runs in the interpreter of an environment with robosuite 1.5.2 and its dependencies (numba, scipy, OpenCV). Discard a
first run there: while numba compiles, robosuite may render wrong frames.
"""

from __future__ import annotations

import json
import os
import sys
import time

import numpy as np
import robosuite

CONTROL_HZ = 20


def main(with_cameras: bool, image_px: int, num_steps: int) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=with_cameras,
        use_camera_obs=with_cameras,
        camera_names=["agentview", "robot0_eye_in_hand"],
        camera_heights=image_px,
        camera_widths=image_px,
        control_freq=CONTROL_HZ,
        horizon=10 * num_steps,
    )
    env.reset()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.3, 0.3, (num_steps, env.action_dim))
    for action in actions[: CONTROL_HZ // 2]:  # not counted
        seen = env.step(action)[0]
    if with_cameras and np.array_equal(seen["agentview_image"], seen["robot0_eye_in_hand_image"]):
        raise RuntimeError("both cameras show the same picture: warm numba's cache with a run that is thrown away")
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    for action in actions:
        env.step(action)
    measured = {
        "simulated_s": num_steps / CONTROL_HZ,
        "wall_s": time.perf_counter() - wall_s,
        "cpu_s": time.process_time() - cpu_s,
    }
    print(json.dumps(measured), flush=True)


if __name__ == "__main__":
    main(sys.argv[1] == "cameras", int(sys.argv[2]), int(sys.argv[3]))
