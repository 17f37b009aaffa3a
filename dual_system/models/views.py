"""Other ways to look at the same scene: moved, mirrored, relit; pictures and words change together.

Training draws such views so that a network from scratch sees things in many places (`training.augment`); serving may
read an episode in several of them and take counsel (`counsel`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.eyes import Eyes
from dual_system.models.place_code import PLACE_PX
from dual_system.models.ponder.coordinates import XY_1000, YX_PX

_SIDE = re.compile(r"\b(?:left|right|clockwise|counterclockwise)\b")
_MIRRORED = {"left": "right", "right": "left", "clockwise": "counterclockwise", "counterclockwise": "clockwise"}
_ROUNDING = 1e-9
_WHOLE = 1000  # of a side, in the texts that PONDER says


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

    @property
    def shows_it_as_it_is(self) -> bool:
        """Nothing is moved, mirrored or relit."""
        return not (self.down_px or self.right_px or self.is_mirrored) and self.gain == 1.0

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
            text = _other_sided(text)
        return YX_PX.sub(self._moved, text)

    def _moved(self, place: re.Match[str]) -> str:
        y, x = int(place[1]), int(place[2])
        x = PLACE_PX - x if self.is_mirrored else x
        y, x = (round(v + shift * self.text_px) for v, shift in ((y, self.down_px), (x, self.right_px)))
        return f"<{min(max(y, 0), PLACE_PX)}, {min(max(x, 0), PLACE_PX)}>"

    def seen(self, text: str) -> str:
        """What PONDER says of the scene, ``[x, y]`` in thousandths, as it would say it in this view."""
        if self.is_mirrored:
            text = _other_sided(text)
        return XY_1000.sub(self._seen, text)

    def meant(self, text: str) -> str:
        """What PONDER says in this view, of the scene as it is: `seen` undone, but at the picture's edge."""
        if self.is_mirrored:
            text = _other_sided(text)
        return XY_1000.sub(self._meant, text)

    @property
    def _shift(self) -> tuple[float, float]:
        """Right and down, in thousandths."""
        thousandths = self.text_px * _WHOLE / PLACE_PX
        return self.right_px * thousandths, self.down_px * thousandths

    def _seen(self, place: re.Match[str]) -> str:
        x, y = int(place[1]), int(place[2])
        x = _WHOLE - x if self.is_mirrored else x
        right, down = self._shift
        return _told(x + right, y + down)

    def _meant(self, place: re.Match[str]) -> str:
        right, down = self._shift
        x, y = int(place[1]) - right, int(place[2]) - down
        return _told(_WHOLE - x if self.is_mirrored else x, y)


AS_IT_IS = View()


def text_px(eyes: Eyes, image_px: tuple[int, int], *, mirrors: bool) -> float:
    """`View.text_px` of a PONDER, whose pictures may be mirrored if ``mirrors``.

    Raises ValueError if it has several eyes or none, or one that is not symmetric and is to be mirrored: where its
    pictures lie in the texts' coordinates is then not told by one number.
    """
    if eyes is None or len(eyes) != 1:
        raise ValueError(f"other views are for a PONDER with one eye, this one has {0 if eyes is None else len(eyes)}")
    top, left, bottom, right = eyes[0].box
    if mirrors and abs(left + right - 1) > _ROUNDING:
        raise ValueError(f"an eye from {left} to {right} is not symmetric about the middle and cannot be mirrored")
    return (bottom - top) * PLACE_PX / image_px[0]


def _told(x: float, y: float) -> str:
    x, y = (min(max(round(value), 0), _WHOLE) for value in (x, y))
    return f"[{x}, {y}]"


def _other_sided(text: str) -> str:
    return _SIDE.sub(lambda side: _MIRRORED[side[0]], text)
