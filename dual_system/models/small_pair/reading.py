"""Observation reader of the demo's PONDER: one crop of one camera, and two tokens of the robot's state.

The crop is reduced to the network's size by an exact mean over whole pixels, so one checkpoint reads cameras of 256 px
and of 128 px; a size without an exact mean is refused, never interpolated. The state's tokens are rows of the
embedding table that no real token uses: the gripper's opening, and the tool's height above the table.

Pure numpy. # h w the network's image_px
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.arm import NUM_ARM_JOINTS, tool_poses
from dual_system.models.ponder.observation import Pictures, Size, check_pictures, px

MAX_SHRINK = 16
"""An input pixel is the mean of at most 16 x 16 camera pixels."""
MAX_FINGER_M, MAX_HEIGHT_M = 0.04, 0.32
"""Upper ends of the bins: one finger's opening, and the tool's height above the table. Larger values clip."""
_NUM_SIZES_SHOWN = 4
_ROUNDING = 1e-6  # px: 0.1 has no exact binary form, yet a tenth of 320 px is 32 px


@dataclass(frozen=True, slots=True, kw_only=True)
class CropReader:
    """The `ObservationReader` that a `ponder.json` declares under ``small_pair``."""

    camera: int
    """Index into the robot's cameras."""
    box: tuple[float, float, float, float]
    """Top, left, bottom, right as fractions of the picture. Edges must lie on pixel borders."""
    first_state_id: int
    """First embedding row of the state's tokens: the finger's bins, then the height's."""
    num_finger_bins: int
    num_height_bins: int

    def __post_init__(self) -> None:
        top, left, bottom, right = self.box
        if self.camera < 0 or not (0 <= top < bottom <= 1 and 0 <= left < right <= 1):
            raise ValueError(f"{self}: expected a camera from 0 and 0 <= top < bottom <= 1, 0 <= left < right <= 1")
        if min(self.num_finger_bins, self.num_height_bins) < 1 or self.first_state_id < 0:
            raise ValueError(f"{self}: bins are at least 1 and rows count from 0")

    @property
    def state_rows(self) -> range:
        return range(self.first_state_id, self.first_state_id + self.num_finger_bins + self.num_height_bins)

    def num_images(self, num_views: int) -> int:
        return 1

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        check_pictures(views)
        if self.camera >= len(views):
            raise ValueError(f"{len(views)} views came; PONDER reads camera {self.camera}, counted from 0")
        return self._shrunk(views[self.camera], image_px)[None]

    def state_ids(self, proprio: ArrayLike | None) -> tuple[int, ...]:
        if proprio is None:
            raise ValueError("this PONDER reads the robot's state with every observation; none came")
        state = np.asarray(proprio, np.float64)
        if state.shape != (ROBOT_DIM,) or not np.isfinite(state).all():
            raise ValueError(f"proprio is {state}; PONDER reads {ROBOT_DIM} finite numbers, 7 joints and a finger")
        height_m = tool_poses(state[:NUM_ARM_JOINTS]).position_m[2]
        finger = _bin(state[-1] / MAX_FINGER_M, self.num_finger_bins)
        height = _bin(height_m / MAX_HEIGHT_M, self.num_height_bins)
        return self.first_state_id + finger, self.first_state_id + self.num_finger_bins + height

    def readable_sizes(self, image_px: Size) -> list[Size]:
        top, left, bottom, right = self.box
        sizes = [
            (round(shrink * image_px[0] / (bottom - top)), round(shrink * image_px[1] / (right - left)))
            for shrink in range(1, MAX_SHRINK + 1)
        ]
        readable = [size for size in sizes if self._crop(size, image_px)]
        if not readable:
            raise ValueError(
                f"no camera size suits the box {self.box} at {px(image_px)} px: it must begin and end on whole pixels "
                f"and be 1 to {MAX_SHRINK} times as large, in both directions alike"
            )
        return readable

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        if self.camera < len(sizes) and self._crop(sizes[self.camera], image_px):
            return None
        return self.camera, self._listed(image_px)

    def _crop(self, size: Size, image_px: Size) -> tuple[slice, slice, int] | None:
        """Rows, columns and reduction factor of the crop in a picture of this size; None if there is no exact one."""
        edges = [fraction * length for fraction, length in zip(self.box, (*size, *size), strict=True)]
        top, left, bottom, right = (round(edge) for edge in edges)
        if any(abs(edge - round(edge)) > _ROUNDING for edge in edges):
            return None
        shrink = (bottom - top) // image_px[0]
        wanted = (shrink * image_px[0], shrink * image_px[1])
        if not 1 <= shrink <= MAX_SHRINK or (bottom - top, right - left) != wanted:
            return None
        return slice(top, bottom), slice(left, right), shrink

    def _shrunk(self, view: Pictures, image_px: Size) -> Pictures:
        size = (view.shape[0], view.shape[1])
        crop = self._crop(size, image_px)
        if crop is None:
            raise ValueError(
                f"camera {self.camera} gives {px(size)} px pictures; PONDER reads {self._listed(image_px)}"
            )
        rows, columns, shrink = crop
        part = view[rows, columns]
        if shrink == 1:
            return part
        # Integer mean, rounded half up: 16 x 16 x 255 plus the half fits into 16 bits. Strided sums are 10 times as
        # fast as a reduction over two axes.
        total = np.full((*image_px, 3), shrink**2 // 2, np.uint16)
        for row in range(shrink):
            for column in range(shrink):
                total += part[row::shrink, column::shrink]
        mean: Pictures = (total // shrink**2).astype(np.uint8)
        return mean

    def _listed(self, image_px: Size) -> str:
        sizes = self.readable_sizes(image_px)
        shown = " or ".join(px(size) for size in sizes[:_NUM_SIZES_SHOWN])
        return f"{shown} px" + (" and so on" if len(sizes) > _NUM_SIZES_SHOWN else "")


def _bin(share: float, num_bins: int) -> int:
    return min(max(int(share * num_bins), 0), num_bins - 1)
