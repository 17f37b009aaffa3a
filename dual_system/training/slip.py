"""Words of a row whose places are wrong: each by its own error, or all others, one place always the same one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dual_system.training.augment import View
from dual_system.training.places import misplaced, scattered


@dataclass(frozen=True, slots=True, kw_only=True)
class Slip:
    """How the places that the words of one row tell differ from what is there."""

    seed: int
    std_px: float | None
    """Of each coordinate; None: `scattered`, for words that are looked up in words."""
    is_learned: bool = False
    """True: errors so small, or so consistent, that PONDER learns to say the words all the same."""

    def saying(self, view: View) -> Callable[[str], str]:
        """Tells one text after the other of a row as it is in this view, its places wrong."""
        if self.std_px is None:
            return lambda text: scattered(view.text(text), self.seed)
        std_px, rng = self.std_px, np.random.default_rng(self.seed)
        return lambda text: misplaced(view.text(text), std_px, rng)
