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
import torch
import torch.nn.functional as F
from torch import Tensor

from ponderpounce.models.context import ContextFormat
from ponderpounce.training.places import PLACE, TEXT_PX, WAY

_SIDED = re.compile(r"left|right|clockwise", re.IGNORECASE)
_SIDE = re.compile(r"\b(?:left|right|clockwise|counterclockwise)\b")
_MIRRORED = {"left": "right", "right": "left", "clockwise": "counterclockwise", "counterclockwise": "clockwise"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """How far views may differ."""

    max_shift_px: int = 0
    """Of PONDER's picture, either way in both directions; edges are repeated."""
    mirror: bool = False
    """Half of the episodes are mirrored, unless their texts speak of sides. Those of ways (`places.WAY`) may: with
    "left" for "right" it is the way that the picture then shows."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One way to look at a whole episode."""

    down_px: int = 0
    right_px: int = 0
    """What is shown moves by so many pixels of PONDER's picture."""
    is_mirrored: bool = False
    """First left and right change places, then it moves."""
    text_px: float = 1.0
    """Pixels of a text's coordinates to one of PONDER's picture."""
    gain: float = 1.0
    """Of all pictures' brightness."""

    def pictures(self, frames_NHW3: Tensor) -> Tensor:
        """(N, height, width, 3) uint8"""
        if self.gain != 1.0:
            frames_NHW3 = (frames_NHW3.float() * self.gain).round().clamp(max=255).to(torch.uint8)
        if self.is_mirrored:
            frames_NHW3 = frames_NHW3.flip(2)
        margin = max(abs(self.down_px), abs(self.right_px))
        if margin == 0:
            return frames_NHW3
        height, width = frames_NHW3.shape[1:3]
        wide = F.pad(frames_NHW3.permute(0, 3, 1, 2).float(), (margin,) * 4, mode="replicate").to(torch.uint8)
        top, left = margin - self.down_px, margin - self.right_px
        return wide[:, :, top : top + height, left : left + width].permute(0, 2, 3, 1)

    def text(self, text: str) -> str:
        """Its coordinates and sides as they are in this view; at the picture's edge where they would leave it."""
        if not (self.down_px or self.right_px or self.is_mirrored):
            return text
        if self.is_mirrored:
            text = _SIDE.sub(lambda side: _MIRRORED[side[0]], text)
        return PLACE.sub(self._moved, text)

    def _moved(self, place: re.Match[str]) -> str:
        y, x = int(place[1]), int(place[2])
        x = TEXT_PX - x if self.is_mirrored else x
        y, x = (round(v + shift * self.text_px) for v, shift in ((y, self.down_px), (x, self.right_px)))
        return f"<{min(max(y, 0), TEXT_PX)}, {min(max(x, 0), TEXT_PX)}>"


AS_IT_IS = View()


def draw_view(config: Augmentation, form: ContextFormat, texts: set[str], rng: np.random.Generator) -> View:
    """Draws the view of an episode.

    Raises:
        ValueError: PONDER has several eyes or none, or one that is not symmetric and is to be mirrored: where its
            pictures lie in the texts' coordinates is then not told by one number.
    """
    gain = float(np.exp(rng.uniform(-1, 1) * np.log1p(config.max_gain))) if config.max_gain else 1.0
    if not config.moves:
        return View(gain=gain)
    if form.eyes is None or len(form.eyes) != 1:
        raise ValueError("moved views are drawn for a PONDER with one eye; leave max_shift_px and mirror out")
    top, left, bottom, right = form.eyes[0].box
    if config.mirror and abs(left + right - 1) > 1e-9:
        raise ValueError(f"an eye from {left} to {right} is not symmetric about the middle and cannot be mirrored")
    down_px, right_px = rng.integers(-config.max_shift_px, config.max_shift_px + 1, size=2).tolist()
    is_sided = any(_SIDED.search(text) and not WAY.search(text) for text in texts)
    is_mirrored = config.mirror and bool(rng.integers(2)) and not is_sided
    text_px = (bottom - top) * TEXT_PX / form.image_px[0]
    return View(down_px=down_px, right_px=right_px, is_mirrored=is_mirrored, text_px=text_px, gain=gain)
