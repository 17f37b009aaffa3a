"""VideoUnmaskSwap: cubes are covered in a video, and then containers change places.

Not a place must be remembered, but each container's path.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks.permanence.scenes import NUM_SHUFFLED, Layout, shuffled
from dual_system.tasks.permanence.unmask import Unmask, watching
from dual_system.tasks.placing import draw_threesome, turned_at_random, until_it_fits
from dual_system.tasks.task import Shown, task

_SQUARE_M = ((-0.05, -0.1), (-0.05, 0.1), (0.1, 0.1), (0.1, -0.1))


@task(family="permanence")
class VideoUnmaskSwap(Unmask):
    """Pick up the containers that hide cubes seen in the video, wherever they have moved since."""

    max_containers = max(NUM_SHUFFLED.values())
    num_buttons = 0
    preamble = "watch the video carefully"

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        return watching(layout)


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    centers_m = _SQUARE_M if NUM_SHUFFLED[difficulty] == 4 else draw_threesome(rng)
    return shuffled(rng, difficulty, turned_at_random(rng, centers_m))
