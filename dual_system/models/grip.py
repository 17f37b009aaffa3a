"""How far apart the fingers are, as the networks are told it.

A script that grasps straight holds a cube of 4 cm with fingers 4 cm apart. What a policy grasps askew holds them
further apart, up to the cube's diagonal, and rows of the script's have that nearly only where something is set down and
about to be let go: a hand that learned from them lets go of what it holds, half-way up. Told as if it hung straight, it
goes on. See docs/training.md, "A firm grip". Pure numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Grip:
    """What lies between the two is told as the first. Of one finger [m], 0 closed, as robots tell it.

    Fingers that open or close pass through it within some 0.2 s and are told the same then.

    Raises:
        ValueError: unless 0 < ``straight_m`` < ``askew_m``.
    """

    straight_m: float
    """Where it is when what it has learned to hold hangs straight."""
    askew_m: float
    """Where the widest grip on that ends."""

    def __post_init__(self) -> None:
        if not 0.0 < self.straight_m < self.askew_m:
            raise ValueError(f"{self}: expected 0 < straight_m < askew_m, in metres of one finger")

    def told_m(self, finger_m: ArrayLike) -> NDArray[np.float64]:
        """Of any shape, and of the same."""
        measured = np.asarray(finger_m, np.float64)
        is_askew = (self.straight_m < measured) & (measured < self.askew_m)
        return np.where(is_askew, self.straight_m, measured)


def as_told(state: NDArray[np.float64], grip: Grip | None) -> NDArray[np.float64]:
    """A robot's states (..., 8), or others whose last number is the finger's [m], as networks are told them."""
    if grip is None:
        return state
    return np.concatenate([state[..., :-1], grip.told_m(state[..., -1:])], axis=-1)
