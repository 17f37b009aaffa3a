"""ButtonUnmaskSwap: cubes are covered and containers change places while the robot presses two buttons.

The clock does not wait for the buttons: the last swap may end before the first press or after the second.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks.permanence.scenes import NUM_SHUFFLED, Layout, draw_button, shuffled
from dual_system.tasks.permanence.unmask import Unmask
from dual_system.tasks.placing import until_it_fits
from dual_system.tasks.task import task

_BUTTON_CENTERS_M, _BUTTON_REACH_M = ((-0.2, -0.1), (-0.2, 0.1)), 0.025
_SHIFT_M = 0.1


@task(family="permanence")
class ButtonUnmaskSwap(Unmask):
    """Press both buttons, then pick up the containers that hide cubes seen in the first 1.6 s."""

    max_containers = max(NUM_SHUFFLED.values())
    num_buttons = 2
    preamble = "first press both buttons on the table"

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    buttons = [draw_button(rng, center_m, _BUTTON_REACH_M) for center_m in _BUTTON_CENTERS_M]
    centers_m = _square(rng) if NUM_SHUFFLED[difficulty] == 4 else _three(rng)
    return shuffled(rng, difficulty, centers_m, buttons)


def _square(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Two rows of two; each row is shifted sideways as a whole."""
    near_m, far_m = (float(shift_m) for shift_m in rng.uniform(0.0, _SHIFT_M, 2))
    return [(0.0, near_m - 0.1), (0.0, near_m + 0.1), (0.1, far_m + 0.1), (0.1, far_m - 0.1)]


def _three(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Three beside each other, the middle one 0.1 m further from the robot or not; each is shifted away on its own."""
    middle_m = float(rng.choice([0.05, -0.05]))
    return [
        (x_m + float(rng.uniform(0.0, _SHIFT_M)), y_m) for x_m, y_m in ((-0.05, -0.15), (-0.05, 0.15), (middle_m, 0.0))
    ]
