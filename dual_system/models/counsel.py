"""Counsel: an episode is read in several views at once, and what most of them say is said in all.

Moved by three pixels, or mirrored, a scene that a small PONDER has read wrongly is often read rightly. So each view
has a context of its own, and after every query they agree (`ponder_server.election`). It is an ensemble of views in
place of networks (test-time augmentation), with one addition: who was outvoted goes on from the words of the others.

The paper has nothing of it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from dual_system.models.eyes import Eyes
from dual_system.models.views import View, text_px

_SIDED = re.compile(r"\b(?:left|right)\b(?! (?:after|before))|clockwise", re.IGNORECASE)
"""Sides that an instruction names. "right after" is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Otherwise:
    """One more way to look: what is shown moves by so many pixels of PONDER's picture, mirrored before or not."""

    down_px: int = 0
    right_px: int = 0
    is_mirrored: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Counsel:
    """In which views an episode is read besides the one as it is; part of a PONDER's checkpoint."""

    others: tuple[Otherwise, ...]
    near: int
    """Thousandths of the picture: places nearer than that are one."""
    on_demonstrations: bool = True
    """False: an episode with a demonstration is read in one view alone. Every further one costs as much again before
    the robot may begin."""

    def __post_init__(self) -> None:
        if not self.others:
            raise ValueError("counsel needs another view at least; leave it out for none")
        if self.near < 1:
            raise ValueError(f"near must be at least 1 thousandth, came {self.near}")

    @property
    def num_views(self) -> int:
        """With the one as it is."""
        return 1 + len(self.others)

    def text_px(self, eyes: Eyes, image_px: tuple[int, int]) -> float:
        """`View.text_px` of all views; raises ValueError where words and pictures would not move together."""
        return text_px(eyes, image_px, mirrors=any(each.is_mirrored for each in self.others))

    def views(self, eyes: Eyes, image_px: tuple[int, int], instruction: str) -> tuple[View, ...]:
        """The views of one episode, the first as it is. None is mirrored where the instruction names a side."""
        scale = self.text_px(eyes, image_px)
        may_mirror = _SIDED.search(instruction) is None
        others = (
            View(
                down_px=each.down_px,
                right_px=each.right_px,
                is_mirrored=each.is_mirrored and may_mirror,
                text_px=scale,
            )
            for each in self.others
        )
        return (View(text_px=scale), *others)
