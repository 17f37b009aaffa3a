"""VideoUnmask: cubes are covered in a video, while the robot stands still."""

from __future__ import annotations

import numpy as np

from dual_system.tasks.permanence.scenes import NUM_SCATTERED, Layout, scattered
from dual_system.tasks.permanence.unmask import Unmask, watching
from dual_system.tasks.task import Shown, task


@task(family="permanence")
class VideoUnmask(Unmask):
    """Pick up the container that hides a cube seen in the video's first 1.6 s."""

    max_containers = max(NUM_SCATTERED.values())
    num_buttons = 0
    preamble = "watch the video carefully"

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return scattered(rng, difficulty, [])

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        return watching(layout)
