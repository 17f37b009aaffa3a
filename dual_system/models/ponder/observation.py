"""What PONDER reads of one observation: which images, of which size, and tokens for the robot's state, if any.

The paper's PONDER reads the whole picture of every camera and nothing else (`WHOLE_VIEWS`). A checkpoint that was
trained to read otherwise declares it in its ponder.json (`checkpoint`); training, serving and the clock's opening all
go through the same reader. Pure numpy, because the daemon's node needs no torch.
"""

# V views (one per camera), E images that the network reads, h w its image_px

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
    """How one observation becomes images and tokens."""

    @property
    def state_rows(self) -> range:
        """Embedding rows of the state's tokens; empty if the state is not read."""
        ...

    def num_images(self, num_views: int) -> int:
        """E for so many views."""
        ...

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        """The views (height, width, 3) uint8, in camera order, as (E, h, w, 3) uint8.

        Raises:
            ValueError: a camera is missing, a view is no uint8 RGB picture, or its size is not readable.
        """
        ...

    def state_ids(self, proprio: ArrayLike | None) -> tuple[int, ...]:
        """The tokens of the robot's state (8,), always as many. Raises ValueError if they need one and none came."""
        ...

    def readable_sizes(self, image_px: Size) -> list[Size]:
        """Camera sizes that can be read, smallest first; never empty."""
        ...

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        """The first camera, by index, whose pictures cannot be read at its size, and the sizes that can."""
        ...


@dataclass(frozen=True, slots=True)
class WholeViews:
    """Every camera's whole picture, at exactly the network's size: the paper's PONDER."""

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
    """Raises ValueError unless every view is a uint8 RGB picture, and of ``size`` if one is given."""
    for index, view in enumerate(views):
        is_picture = view.dtype == np.uint8 and view.ndim == 3 and view.shape[2] == 3
        if not is_picture or (size is not None and view.shape[:2] != size):
            expected = "(height, width, 3)" if size is None else (*size, 3)
            raise ValueError(f"frame {index}: {view.dtype} of shape {view.shape}; expected uint8 {expected}")


def check_cameras(sizes: Sequence[Size], reader: ObservationReader, image_px: Size) -> None:
    """Raises ValueError, naming the sizes that would do, unless PONDER can read cameras of these sizes."""
    found = reader.unreadable(sizes, image_px)
    if found is not None:
        camera, wanted = found
        came = px(sizes[camera]) + " px pictures" if camera < len(sizes) else "none"
        raise ValueError(f"camera {camera} gives {came}; PONDER reads {wanted}")


def px(size: Size) -> str:
    """A size as text."""
    return f"{size[0]} x {size[1]}"
