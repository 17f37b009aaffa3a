"""Objects that change places in a demonstration, as soon as the arm has rested for a second.

The time depends on the duration of the previous motions, so it is remembered, not scheduled; so are the places of the
objects, because some have been carried. Source: RoboMME at 598e3b4, rules restated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dual_system.tasks import predicates, swaps
from dual_system.tasks.captions import letter
from dual_system.tasks.geometry import Spot, transform
from dual_system.tasks.oracle import REST_XYZ_M, Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.swaps import SWAP_STEPS, Swap

REST_STEPS = 20

_NEAR_REST_M = 0.05
_LEAD_STEPS = 2  # from the observation that completes the rest to the one at which the first swap begins


@dataclass(frozen=True, slots=True, kw_only=True)
class Rest:
    """Steps that the arm has rested in the demonstration; after `REST_STEPS`, the first swap's step and places."""

    num_steps: int = 0
    first_swap_step: int | None = None
    spots: tuple[Spot, ...] = ()


def rest(motions: Motions) -> Actions:
    """The motion before objects move: the arm rests long enough, where it hides nothing."""
    yield from motions.rest()
    yield from motions.wait(REST_STEPS)


def watch(before: Rest | None, physics: Physics, names: Sequence[str]) -> Rest | None:
    """Returns the rest after one more observation; ``names`` are the bodies that may change places.

    It is None outside a demonstration. Memories begin anew after it, but the clock runs through: only the first frame
    of a demonstration has a single control step behind it.
    """
    if before is None:
        return Rest() if physics.elapsed_steps() == 1 else None
    if before.first_swap_step is not None:
        return before
    away_m = np.linalg.norm(physics.tcp_transform()[:3, 3] - REST_XYZ_M)
    is_resting = away_m <= _NEAR_REST_M and predicates.is_still(physics)
    num_steps = before.num_steps + 1 if is_resting else 0
    if num_steps < REST_STEPS:
        return Rest(num_steps=num_steps)
    observed_step = physics.elapsed_steps() - 1
    spots = tuple(_spot_of(physics, name) for name in names)
    return Rest(num_steps=num_steps, first_swap_step=observed_step + _LEAD_STEPS, spots=spots)


def move(
    physics: Physics,
    rested: Rest | None,
    names: Sequence[str],
    pairs: Sequence[Swap],
    *,
    step: int,
    lane_m: float,
    z_m: float,
) -> None:
    """Places objects for the observation of ``step``; ``pairs`` change places one after the other.

    Before and after that nothing is touched. ``lane_m`` is as in `swaps.spots_after`, ``z_m`` their origins' height.
    """
    if rested is None or rested.first_swap_step is None or not pairs:
        return
    elapsed_steps = step - rested.first_swap_step
    if 0 <= elapsed_steps <= SWAP_STEPS * len(pairs):
        for name, spot in zip(names, swaps.spots_after(rested.spots, pairs, elapsed_steps, lane_m), strict=True):
            physics.place(name, spot.pose(z_m))
        physics.refresh()


def in_words(pairs: Sequence[Swap], y_m: Sequence[float]) -> str:
    """Returns the swaps by letter, as in "swaps A <-> C, A <-> B"; ``y_m`` holds the objects' initial places."""
    if not pairs:
        return "no swaps"
    return "swaps " + ", ".join(f"{letter(first, y_m)} <-> {letter(second, y_m)}" for first, second in pairs)


def _spot_of(physics: Physics, name: str) -> Spot:
    T = transform(physics.pose(name))
    return Spot(x_m=float(T[0, 3]), y_m=float(T[1, 3]), yaw_rad=float(np.arctan2(T[1, 0], T[0, 0])))
