"""VideoUnmask: cubes are covered in a video, while the robot stands still."""

from __future__ import annotations

import numpy as np

from dual_system.tasks.permanence.scenes import NUM_SCATTERED, Layout, scattered
from dual_system.tasks.permanence.unmask import Pressed, Unmask, container_name, watching
from dual_system.tasks.physics import Physics
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

    def first_choice(self, physics: Physics, memory: Pressed, layout: Layout, index: int) -> bool | None:
        """The first container that both fingers hold, lifted or not, hides the cube that is asked for first."""
        tool_m = physics.tcp_transform()[:3, 3]
        containers = [container_name(index) for index in range(len(layout.containers))]
        nearest = min(containers, key=lambda name: float(np.linalg.norm(physics.position_m(name) - tool_m)))
        if not physics.is_grasped(nearest):  # no other one can be between the fingers
            return None
        return nearest == container_name(layout.hidden[0].container)
