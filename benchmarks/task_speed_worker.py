"""The measured half of ``task_speed``, one process on one core: oracle episodes rendered at a rate. Prints JSON."""

from __future__ import annotations

import json
import os
import sys
import time

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import make_environment
from dual_system.tasks.physics import CONTROL_HZ


def main(task: str, look_hz: int, image_px: int, seeds: list[int]) -> None:
    """Prints one line per seed, after an uncounted episode."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    every = CONTROL_HZ // look_hz if look_hz else 0
    with make_environment(task, image_px=image_px, render=look_hz > 0) as env:
        for is_counted, seed in [(False, seeds[0]), *((True, seed) for seed in seeds)]:
            wall_s, cpu_s, step_wall_s, step_cpu_s = time.perf_counter(), time.process_time(), 0.0, 0.0
            env.reset(seed)
            num_shown = sum(1 for _ in env.demonstration(CONTROL_HZ, look_hz=look_hz or None))
            num_steps = 0
            for action in env.oracle():
                before_wall_s, before_cpu_s = time.perf_counter(), time.process_time()
                snapshot = env.step(action, look=bool(every) and (num_steps + 1) % every == 0)
                step_wall_s += time.perf_counter() - before_wall_s
                step_cpu_s += time.process_time() - before_cpu_s
                num_steps += 1
                if snapshot.status is not Status.ONGOING:
                    break
            if is_counted:
                measured = {
                    "difficulty": env.difficulty,
                    "success": snapshot.status is Status.SUCCESS,
                    "simulated_s": (num_steps + num_shown) / CONTROL_HZ,
                    "stepped_s": num_steps / CONTROL_HZ,
                    "wall_s": time.perf_counter() - wall_s,
                    "cpu_s": time.process_time() - cpu_s,
                    "step_wall_s": step_wall_s,
                    "step_cpu_s": step_cpu_s,
                }
                print(json.dumps(measured), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), [int(seed) for seed in sys.argv[4].split(",")])
