"""ButtonUnmask: cubes are covered while the robot is on its way to a button.

The button only fixes the order of subtasks: the cubes are covered at a fixed time, whether or not it was pressed.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks.permanence.scenes import NUM_SCATTERED, Layout, draw_button, scattered
from dual_system.tasks.permanence.unmask import Unmask
from dual_system.tasks.task import task

_BUTTON_CENTER_M, _BUTTON_REACH_M = (-0.2, 0.0), 0.05


@task(family="permanence")
class ButtonUnmask(Unmask):
    """Press the button, then pick up the container that hides a cube seen in the first 1.6 s."""

    max_containers = max(NUM_SCATTERED.values())
    num_buttons = 1
    preamble = "first press the button"

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return scattered(rng, difficulty, [draw_button(rng, _BUTTON_CENTER_M, _BUTTON_REACH_M)])
