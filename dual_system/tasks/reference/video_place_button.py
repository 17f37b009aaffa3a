"""VideoPlaceButton: on which target was the cube placed right before, or right after, the button was pressed?

The video shows one placing, the button, and another placing. A coin decides which of the two is asked for.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks.placing import until_it_fits
from dual_system.tasks.reference.video_place import Layout, VideoPlace, draw_scene, draw_swaps
from dual_system.tasks.task import task

_NUM_TARGETS = {"easy": 3, "medium": 4, "hard": 4}
_PARKING_RADIUS_M = 0.06


@task(family="reference")
class VideoPlaceButton(VideoPlace):
    """Place a cube on the target that it was placed on right before or right after the button was pressed."""

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def which(self, layout: Layout) -> str:
        relation = "before" if layout.asked < layout.num_before_press else "after"
        return f"target right {relation} the button was pressed"


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    num_targets = _NUM_TARGETS[difficulty]
    button_xy_m, parking_xy_m, cubes, targets_xy_m = draw_scene(
        rng, difficulty, num_targets=num_targets, parking_radius_m=_PARKING_RADIUS_M
    )
    return Layout(
        button_xy_m=button_xy_m,
        parking_xy_m=parking_xy_m,
        cubes=cubes,
        targets_xy_m=targets_xy_m,
        carried=0,
        visits=(0, 1),
        num_before_press=1,
        asked=int(rng.integers(2)),
        swaps=draw_swaps(rng, difficulty, num_targets),
    )
