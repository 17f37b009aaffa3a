"""What POUNCE is told while it learns to obey: a grounded text, a simple one, or the task alone, drawn anew each time.

One hand then serves every kind of text, and none: what stands in for a pretrained POUNCE at laptop size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dual_system.models.ponder.coordinates import moved_places, without_places


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """Shares of invocations by what they are told; the rest gets the task alone."""

    grounded: float
    simple: float
    jitter_px: float = 0.0
    """Standard deviation of a told place, in pixels of a 256 px picture."""
    far_share: float = 0.0
    """Share of grounded texts whose places are ``far_px`` off, in any direction: the hand then has to look."""
    far_px: float = 0.0

    def __post_init__(self) -> None:
        if min(self.grounded, self.simple, self.jitter_px, self.far_px) < 0 or self.grounded + self.simple > 1:
            raise ValueError(f"{self}: shares are at least 0 and at most 1 together; distances at least 0")

    def draw(self, text: str, rng: np.random.Generator) -> str:
        """The text for one invocation, from PONDER's newest subgoal."""
        kind, direction_rad, is_far = rng.random(), rng.uniform(0, 2 * np.pi), rng.random() < self.far_share
        offset = rng.normal(0, self.jitter_px, 2)
        if kind >= self.grounded + self.simple:
            return ""
        if kind >= self.grounded:
            return without_places(text)
        if is_far:
            offset = offset + self.far_px * np.array([np.cos(direction_rad), np.sin(direction_rad)])
        x_px, y_px = np.rint(offset).astype(int).tolist()
        return moved_places(text, (x_px, y_px))
