"""Eyes: through which cameras PONDER looks, at which part of their pictures, and at what size.

A small PONDER needs one camera and a fixed crop of the workspace. Training and serving both see through ``see``. What
an eye sees is brought to the network's size by an exact mean over whole pixels, so one checkpoint reads cameras of
256 px and of 128 px; where no exact mean exists the picture is refused, never interpolated.

Pure numpy, for the daemon's doors need no torch. # E eyes, h w the network's image_px
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Pictures: TypeAlias = npt.NDArray[np.uint8]
Size: TypeAlias = tuple[int, int]
"""Height and width in pixels."""

MAX_SHRINK = 16
"""A pixel that PONDER sees is the mean of at most 16 x 16 of the camera's."""
NUM_SIZES_SHOWN = 4
_ROUNDING = 1e-6  # px: 0.1 has no exact binary form, yet a tenth of 320 px is 32 px


@dataclass(frozen=True, slots=True, kw_only=True)
class Eye:
    """One picture per look: a part of one camera's."""

    camera: int
    """Index into the robot's cameras, in the order of its observations (0 front, 1 wrist on the Panda)."""
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    """Top, left, bottom, right as fractions of the picture. Edges must fall between two pixels."""

    def __post_init__(self) -> None:
        if self.camera < 0:
            raise ValueError(f"eye: camera is {self.camera}; cameras count from 0.")
        if len(self.box) != 4:
            raise ValueError(f"eye: box {self.box} needs four fractions: top, left, bottom, right.")
        top, left, bottom, right = self.box
        if not (0 <= top < bottom <= 1 and 0 <= left < right <= 1):
            raise ValueError(
                f"eye: box {self.box} must be top < bottom and left < right, as fractions of the picture in 0..1."
            )


Eyes: TypeAlias = tuple[Eye, ...] | None
"""None: every picture that comes, whole, at exactly the network's size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crop:
    rows: slice
    columns: slice
    shrink: int
    """Side in pixels of the squares that become one pixel each."""


def check_eyes(eyes: Eyes, image_px: Size) -> None:
    """Raises ValueError for no eye at all, or for eyes that no one size of picture suits."""
    if eyes == ():
        raise ValueError("eyes are (); a PONDER needs at least one, or None for every camera's whole picture.")
    if not readable_sizes(eyes, image_px):
        raise ValueError(
            f"no size of camera suits {eyes} at {_px(image_px)} px: every box must begin and end on whole pixels and "
            f"be 1 to {MAX_SHRINK} times as large, in both directions alike."
        )


def num_seen(num_views: int, eyes: Eyes) -> int:
    """Pictures that PONDER reads of ``num_views`` views of one instant."""
    return num_views if eyes is None else len(eyes)


def see(views: Sequence[Pictures], eyes: Eyes, image_px: Size) -> Pictures:
    """One instant's views (height, width, 3) uint8, in camera order, as PONDER reads them: (E, h, w, 3) uint8.

    What was seen once is seen again with ``eyes=None``: ``see(see(views, eyes, px), None, px)`` changes nothing.

    Raises:
        ValueError: a camera is missing, a view is no uint8 RGB picture, or its size is not readable.
    """
    for index, view in enumerate(views):
        is_picture = view.dtype == np.uint8 and view.ndim == 3 and view.shape[2] == 3
        if not is_picture or (eyes is None and view.shape[:2] != image_px):
            expected = (*image_px, 3) if eyes is None else "(height, width, 3)"
            raise ValueError(f"frame {index}: {view.dtype} of shape {view.shape}; expected uint8 {expected}")
    if eyes is None:
        return np.stack(views)
    for eye in eyes:
        if eye.camera >= len(views):
            raise ValueError(f"{len(views)} views came and an eye looks through camera {eye.camera}, counted from 0")
    return np.stack([_seen(views[eye.camera], eye, image_px) for eye in eyes])


def unreadable(sizes: Sequence[Size], eyes: Eyes, image_px: Size) -> tuple[int, str] | None:
    """The first camera, by index, whose pictures of that size PONDER cannot read, and the sizes that it could."""
    for camera, size in enumerate(sizes):
        used = None if eyes is None else tuple(eye for eye in eyes if eye.camera == camera)
        readable = size == image_px if used is None else all(_crop(eye, size, image_px) for eye in used)
        if not readable:
            return camera, _listed(readable_sizes(used, image_px))
    return None


def check_cameras(sizes: Sequence[Size], eyes: Eyes, image_px: Size) -> None:
    """Raises ValueError, naming the sizes that would do, unless PONDER can read cameras of these sizes."""
    last_camera = max((eye.camera for eye in eyes or ()), default=0)
    if last_camera >= len(sizes):
        raise ValueError(f"PONDER looks through camera {last_camera}, counted from 0; there are {len(sizes)}")
    found = unreadable(sizes, eyes, image_px)
    if found is not None:
        camera, wanted = found
        raise ValueError(f"camera {camera} gives {_px(sizes[camera])} px pictures; PONDER reads {wanted}")


def readable_sizes(eyes: Eyes, image_px: Size) -> list[Size]:
    """Picture sizes that all ``eyes`` can read, smallest first; [] if no size suits all of them."""
    if not eyes:
        return [image_px]
    top, left, bottom, right = eyes[0].box
    sizes = [
        (round(shrink * image_px[0] / (bottom - top)), round(shrink * image_px[1] / (right - left)))
        for shrink in range(1, MAX_SHRINK + 1)
    ]
    return [size for size in sizes if all(_crop(eye, size, image_px) for eye in eyes)]


def _crop(eye: Eye, size: Size, image_px: Size) -> _Crop | None:
    """Where the eye looks in a picture of this size; None if it cannot."""
    edges = [fraction * length for fraction, length in zip(eye.box, (*size, *size), strict=True)]
    top, left, bottom, right = (round(edge) for edge in edges)
    if any(abs(edge - round(edge)) > _ROUNDING for edge in edges):
        return None
    shrink = (bottom - top) // image_px[0]
    if not 1 <= shrink <= MAX_SHRINK or (bottom - top, right - left) != (shrink * image_px[0], shrink * image_px[1]):
        return None
    return _Crop(rows=slice(top, bottom), columns=slice(left, right), shrink=shrink)


def _seen(view: Pictures, eye: Eye, image_px: Size) -> Pictures:
    size = (view.shape[0], view.shape[1])
    crop = _crop(eye, size, image_px)
    if crop is None:
        wanted = _listed(readable_sizes((eye,), image_px))
        raise ValueError(f"camera {eye.camera} gives {_px(size)} px pictures; PONDER reads {wanted}")
    part = view[crop.rows, crop.columns]
    if crop.shrink == 1:
        return part
    num_pixels = crop.shrink**2
    # Half up, in whole numbers: 16 x 16 x 255 and the half fit into 16 bits. Strided sums are 10 times as fast as a
    # reduction over two axes.
    total = np.full((*image_px, 3), num_pixels // 2, np.uint16)
    for row in range(crop.shrink):
        for column in range(crop.shrink):
            total += part[row :: crop.shrink, column :: crop.shrink]
    mean: Pictures = (total // num_pixels).astype(np.uint8)
    return mean


def _listed(sizes: Sequence[Size]) -> str:
    shown = " or ".join(_px(size) for size in sizes[:NUM_SIZES_SHOWN])
    return f"{shown} px" + (" and so on" if len(sizes) > NUM_SIZES_SHOWN else "")


def _px(size: Size) -> str:
    return f"{size[0]} x {size[1]}"
