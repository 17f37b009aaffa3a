"""A fixed window of each camera's picture, reduced to a network's size by area.

A network at laptop size reads 64 px: the whole front picture would leave four of them for a cube. Its windows are
fractions of the picture, so cameras of any size will do, and every pixel is the mean of the camera's pixels that it
covers. The same windows stand in PONDER's and POUNCE's checkpoints.

Pure numpy. # h w the network's image_px
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.models.ponder.observation import Pictures, Size, check_pictures, px

Box: TypeAlias = tuple[float, float, float, float]
"""Top, left, bottom and right edge, as fractions of the picture."""

WHOLE: Box = (0.0, 0.0, 1.0, 1.0)
LAPTOP_WINDOWS = ((10 / 128, 28 / 128, 82 / 128, 100 / 128), WHOLE)
"""Front and wrist camera of the pair at laptop size. The front one is the workspace: nine sixteenths of the picture,
which at 64 px is 2.25 pixels of a 256 px camera to each of ours."""


@dataclass(frozen=True, slots=True)
class Windows:
    """The `ObservationReader` of networks that read one window a camera."""

    boxes: tuple[Box, ...]
    """In the order of the robot's cameras."""

    def __post_init__(self) -> None:
        for top, left, bottom, right in self.boxes:
            if not (0 <= top < bottom <= 1 and 0 <= left < right <= 1):
                raise ValueError(f"{self}: expected 0 <= top < bottom <= 1 and 0 <= left < right <= 1 in every box")

    @property
    def state_rows(self) -> range:
        return range(0)

    def num_images(self, num_views: int) -> int:
        return num_views

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        check_pictures(views)
        if len(views) > len(self.boxes):
            raise ValueError(f"{len(views)} views came; there are windows for {len(self.boxes)} cameras")
        return np.stack([seen_through(box, view, image_px) for box, view in zip(self.boxes, views, strict=False)])

    def state_ids(self, proprio: ArrayLike | None) -> tuple[int, ...]:
        return ()

    def readable_sizes(self, image_px: Size) -> list[Size]:
        return [_least(image_px, max(self.boxes, key=lambda box: max(_enlarged(box))))]

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        for camera, (size, box) in enumerate(zip(sizes, self.boxes, strict=False)):
            least = _least(image_px, box)
            if size[0] < least[0] or size[1] < least[1]:
                return camera, f"pictures of at least {px(least)} px"
        if len(sizes) > len(self.boxes):
            return len(self.boxes), f"{len(self.boxes)} cameras"
        return None


def seen_through(box: Box, view: Pictures, image_px: Size) -> Pictures:
    """The window of a picture (height, width, 3) as (h, w, 3) uint8; never enlarged.

    Raises:
        ValueError: the window has fewer pixels than ``image_px``.
    """
    height, width = view.shape[:2]
    least = _least(image_px, box)
    if height < least[0] or width < least[1]:
        raise ValueError(f"pictures of {px((height, width))} px came; this window needs at least {px(least)} px")
    top, left, bottom, right = box
    rows = _shares(top, bottom, height, image_px[0])
    columns = _shares(left, right, width, image_px[1])
    mean = np.einsum("rh,hwc->rwc", rows, view, optimize=True)
    window: Pictures = np.rint(np.einsum("cw,rwk->rck", columns, mean, optimize=True)).astype(np.uint8)
    return window


def through(boxes: Sequence[Box], frames: Sequence[Pictures | None], image_px: Size) -> list[Pictures | None]:
    """The windows of the cameras that are there; the frames as they came if there are no windows."""
    if not boxes:
        return list(frames)
    if len(frames) > len(boxes):
        raise ValueError(f"{len(frames)} views came; there are windows for {len(boxes)} cameras")
    pairs = zip(boxes, frames, strict=False)
    return [None if frame is None else seen_through(box, frame, image_px) for box, frame in pairs]


def placed_in(box: Box, row_column: ArrayLike) -> NDArray[np.float64]:
    """Points (..., 2) of the picture, row and column as fractions of it, as fractions of the window."""
    top, left, bottom, right = box
    placed: NDArray[np.float64] = (np.asarray(row_column) - (top, left)) / (bottom - top, right - left)
    return placed


@lru_cache(maxsize=64)
def _shares(begin: float, end: float, length: int, count: int) -> NDArray[np.float64]:
    """(count, length): each row gives the camera's pixels that one of ours covers, as shares that sum to 1."""
    edges = np.linspace(begin, end, count + 1) * length
    low, high = edges[:-1, None], edges[1:, None]
    pixels = np.arange(length)
    covered = (np.minimum(high, pixels + 1) - np.maximum(low, pixels)).clip(min=0)
    shares: NDArray[np.float64] = covered / (high - low)
    return shares


def _enlarged(box: Box) -> tuple[float, float]:
    top, left, bottom, right = box
    return 1 / (bottom - top), 1 / (right - left)


def _least(image_px: Size, box: Box) -> Size:
    """The smallest picture whose window has ``image_px``."""
    height, width = (int(np.ceil(side * times - 1e-6)) for side, times in zip(image_px, _enlarged(box), strict=True))
    return height, width
