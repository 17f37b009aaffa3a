"""The unmasking tasks' scenes: where containers stand, which hide cubes, and which of them change places.

The order of the draws is part of a task: change it, and every seed gives another scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dual_system.tasks import swaps
from dual_system.tasks.containers import draw_spots
from dual_system.tasks.geometry import Footprint, Spot
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS, SceneFullError, sample_footprint
from dual_system.tasks.swaps import SWAP_STEPS, Swap

SWAP_STEP = 64  # the first swap begins
LANE_M = 0.07

NUM_SCATTERED = {"easy": 3, "medium": 5, "hard": 15}  # containers; fewer when no more fit
_NUM_SCATTERED_PICKS = {"easy": 1, "medium": 1, "hard": 2}
_AREA_HALF_M, _SCATTERED_GAP_M = 0.2, 0.04

NUM_SHUFFLED = {"easy": 3, "medium": 4, "hard": 4}
_PICKS = {"easy": (1, 2), "medium": (1, 1), "hard": (2, 2)}  # fewest and most
_SWAPS = {"easy": (1, 2), "medium": (1, 2), "hard": (2, 3)}
_JITTER_HALF_M, _SHUFFLED_GAP_M = 0.07, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Hidden:
    """A cube and the container over it."""

    color: str
    container: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One scene: initial places, the cubes' containers, and the containers' swaps."""

    buttons_xy_m: tuple[tuple[float, float], ...] = ()
    containers: tuple[Spot, ...]
    hidden: tuple[Hidden, ...]  # in the order they are asked for
    num_picks: int  # how many of them are asked for
    swaps: tuple[Swap, ...] = ()

    @property
    def last_event_step(self) -> int:
        """The first observation after all scripted motion."""
        return SWAP_STEP + SWAP_STEPS * len(self.swaps)


def scattered(rng: np.random.Generator, difficulty: str, buttons: Sequence[Footprint]) -> Layout:
    """Draws containers anywhere in a square about the origin, clear of the buttons; the first three hide cubes."""
    centers_m = [(0.0, 0.0)] * NUM_SCATTERED[difficulty]
    return Layout(
        buttons_xy_m=tuple(button.center_m for button in buttons),
        containers=draw_spots(rng, centers_m, half_m=_AREA_HALF_M, obstacles=buttons, gap_m=_SCATTERED_GAP_M),
        hidden=_draw_hidden(rng, range(3)),
        num_picks=_NUM_SCATTERED_PICKS[difficulty],
    )


def shuffled(
    rng: np.random.Generator,
    difficulty: str,
    centers_m: Sequence[tuple[float, float]],
    buttons: Sequence[Footprint] = (),
) -> Layout:
    """Draws one container near each centre, which of them hide cubes, and who changes places with whom.

    A swap is between a container drawn for it and the one nearest to it when it begins. The first two drawn hide
    cubes; whether they are the ones asked for is left to chance.
    """
    num_picks, num_swaps = (int(rng.integers(low, high + 1)) for low, high in (_PICKS[difficulty], _SWAPS[difficulty]))
    spots = draw_spots(rng, centers_m, half_m=_JITTER_HALF_M, obstacles=buttons, gap_m=_SHUFFLED_GAP_M)
    if len(spots) < len(centers_m):
        raise SceneFullError(f"no room for container {len(spots) + 1} of {len(centers_m)}. Draw the scene again.")
    movers = [int(i) for i in rng.permutation(3)[:2]]
    movers.append(int(rng.choice([i for i in range(len(spots)) if i not in movers])))
    pairs: list[Swap] = []
    for mover in movers[:num_swaps]:
        now = swaps.spots_after(spots, pairs, SWAP_STEPS * len(pairs), LANE_M)
        pairs.append((mover, swaps.nearest(now, mover)))
    return Layout(
        buttons_xy_m=tuple(button.center_m for button in buttons),
        containers=spots,
        hidden=_draw_hidden(rng, rng.permutation(3)),
        num_picks=num_picks,
        swaps=tuple(pairs),
    )


def draw_button(rng: np.random.Generator, center_m: tuple[float, float], reach_m: float) -> Footprint:
    """Draws a button's place, uniform in a square about a point."""
    return sample_footprint(
        rng,
        center_m=center_m,
        reach_m=(reach_m, reach_m),
        half_m=BUTTON_HALF_M,
        yaw_range_rad=(0.0, 0.0),
        obstacles=(),
        gap_m=0.0,
    )


def _draw_hidden(rng: np.random.Generator, containers: Iterable[int]) -> tuple[Hidden, ...]:
    """Puts a cube under each of three containers, in random order of the colours."""
    colors = rng.permutation(list(CUBE_COLORS))
    return tuple(Hidden(color=str(color), container=int(i)) for color, i in zip(colors, containers, strict=True))
