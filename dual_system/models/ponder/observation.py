"""PONDER's inputs from one observation: images of the network's size, and tokens for the robot's state, if any.

The paper's PONDER reads the whole picture of every camera and nothing else (`WHOLE_VIEWS`). A checkpoint that was
trained on other inputs declares them in its ponder.json (`checkpoint`); training, serving and the clock's opening all
use the same reader. Pure numpy, because the daemon's node needs no torch.
"""

# V views (one per camera), E images for the network, h w its image_px

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

Pictures: TypeAlias = npt.NDArray[np.uint8]
Size: TypeAlias = tuple[int, int]
"""Height and width in pixels."""


class ObservationReader(Protocol):
    """Maps one observation to images and tokens."""

    @property
    def state_rows(self) -> range:
        """Embedding rows of the state's tokens; empty if the state is not read."""
        ...

    def num_images(self, num_views: int) -> int:
        """E for ``num_views`` views."""
        ...

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        """The views (height, width, 3) uint8, in camera order, as (E, h, w, 3) uint8.

        Raises:
            ValueError: a camera is missing, a view is no uint8 RGB picture, or its size is not supported.
        """
        ...

    def state_ids(self, proprio: ArrayLike | None) -> tuple[int, ...]:
        """Tokens of the robot's state (8,), a fixed number. Raises ValueError if it reads the state and got None."""
        ...

    def readable_sizes(self, image_px: Size) -> list[Size]:
        """Supported camera sizes, smallest first; never empty."""
        ...

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        """Index of the first camera whose size is not supported, and the supported sizes as text; None if all are."""
        ...


@dataclass(frozen=True, slots=True)
class WholeViews:
    """Reads every camera's whole picture, at exactly the network's size: the paper's PONDER."""

    @property
    def state_rows(self) -> range:
        return range(0)

    def num_images(self, num_views: int) -> int:
        return num_views

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        check_pictures(views, image_px)
        return np.stack(views)

    def state_ids(self, proprio: ArrayLike | None) -> tuple[int, ...]:
        return ()

    def readable_sizes(self, image_px: Size) -> list[Size]:
        return [image_px]

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        wrong = next((camera for camera, size in enumerate(sizes) if size != image_px), None)
        return None if wrong is None else (wrong, f"{px(image_px)} px")


WHOLE_VIEWS = WholeViews()


def check_pictures(views: Sequence[Pictures], size: Size | None = None) -> None:
    """Raises ValueError unless every view is a uint8 RGB picture, of ``size`` if given."""
    for index, view in enumerate(views):
        is_picture = view.dtype == np.uint8 and view.ndim == 3 and view.shape[2] == 3
        if not is_picture or (size is not None and view.shape[:2] != size):
            expected = "(height, width, 3)" if size is None else (*size, 3)
            raise ValueError(f"frame {index}: {view.dtype} of shape {view.shape}; expected uint8 {expected}")


def check_cameras(sizes: Sequence[Size], reader: ObservationReader, image_px: Size) -> None:
    """Raises ValueError, naming the supported sizes, unless PONDER can read cameras of these sizes."""
    found = reader.unreadable(sizes, image_px)
    if found is not None:
        camera, wanted = found
        came = px(sizes[camera]) + " px pictures" if camera < len(sizes) else "none"
        raise ValueError(f"camera {camera} gives {came}; PONDER reads {wanted}")


def px(size: Size) -> str:
    """A size as text."""
    return f"{size[0]} x {size[1]}"
