"""VideoPlaceOrder: on which target was the cube placed first, second, third or fourth?

The video shows two to four placings; the button is pressed after one of them and means nothing.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks import captions
from dual_system.tasks.placing import until_it_fits
from dual_system.tasks.reference.video_place import Layout, VideoPlace, draw_scene, draw_swaps
from dual_system.tasks.task import task

_NUM_TARGETS = 4
_MIN_VISITS = 2
_PARKING_RADIUS_M = 0.1


@task(family="reference")
class VideoPlaceOrder(VideoPlace):
    """Place a cube on the n-th target on which it was placed in the video."""

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def which(self, layout: Layout) -> str:
        return f"{captions.ORDINALS[layout.asked]} target it was previously placed on"


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button_xy_m, parking_xy_m, cubes, targets_xy_m = draw_scene(
        rng, difficulty, num_targets=_NUM_TARGETS, parking_radius_m=_PARKING_RADIUS_M
    )
    swaps = draw_swaps(rng, difficulty, _NUM_TARGETS)
    num_visits = int(rng.integers(_MIN_VISITS, _NUM_TARGETS, endpoint=True))
    return Layout(
        button_xy_m=button_xy_m,
        parking_xy_m=parking_xy_m,
        cubes=cubes,
        targets_xy_m=targets_xy_m,
        carried=0,
        visits=tuple(int(i) for i in rng.permutation(_NUM_TARGETS)[:num_visits]),
        num_before_press=1 + int(rng.integers(num_visits)),
        asked=int(rng.integers(num_visits)),
        swaps=swaps,
    )
