"""Other views of the same scene for a PONDER that learns to see from few hundred of them: moved, mirrored, relit.

Pictures and words change together, so nothing that was shown is lost and every text stays true. A patch then sees its
cubes at every place within itself, which is what a vision tower from scratch otherwise learns only from many scenes.
The light is one for a whole row and the same for red, green and blue: what is lit up for a second, and what is called
by its colour, can be told from the rest as before.
POUNCE acts in the real scene: stages that train it do not use this.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from dual_system.models.ponder.context import ContextFormat
from dual_system.models.views import AS_IT_IS, View, text_px
from dual_system.training.insertions import manner
from dual_system.training.places import WAY

__all__ = ["AS_IT_IS", "NOT_AUGMENTED", "Augmentation", "View", "draw_view"]

_SIDED = re.compile(r"left|right|clockwise", re.IGNORECASE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """How far views may differ."""

    max_shift_px: int = 0
    """Of PONDER's picture, either way in both directions; edges are repeated."""
    mirror: bool = False
    """Half of the episodes are mirrored, unless their texts speak of sides. Those of ways (`places.WAY`) may, and of
    what is put into a box (`insertions`): with "left" for "right" it is what the picture then shows."""
    max_gain: float = 0.0
    """Pictures are brighter or darker, at most 1 + that times or 1 / (1 + that); every factor is as likely."""

    def __post_init__(self) -> None:
        if not 0 <= self.max_gain < np.inf:
            raise ValueError(f"max_gain must be at least 0 and finite, came {self.max_gain}")
        if self.max_shift_px < 0:
            raise ValueError(f"max_shift_px must be at least 0, came {self.max_shift_px}")

    @property
    def moves(self) -> bool:
        """Things may be shown elsewhere than they are."""
        return self.max_shift_px > 0 or self.mirror


NOT_AUGMENTED = Augmentation()


def draw_view(config: Augmentation, form: ContextFormat, texts: set[str], rng: np.random.Generator) -> View:
    """Draws the view of an episode.

    Raises:
        ValueError: PONDER's eyes do not fit (`text_px`); leave max_shift_px and mirror out.
    """
    gain = float(np.exp(rng.uniform(-1, 1) * np.log1p(config.max_gain))) if config.max_gain else 1.0
    if not config.moves:
        return View(gain=gain)
    scale = text_px(form.eyes, form.image_px, mirrors=config.mirror)
    down_px, right_px = rng.integers(-config.max_shift_px, config.max_shift_px + 1, size=2).tolist()
    is_sided = any(_SIDED.search(text) and not (WAY.search(text) or manner(text)) for text in texts)
    is_mirrored = config.mirror and bool(rng.integers(2)) and not is_sided
    return View(down_px=down_px, right_px=right_px, is_mirrored=is_mirrored, text_px=scale, gain=gain)
