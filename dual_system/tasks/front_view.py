"""Where the front camera stands, and where it sees a point of the world: without a simulator, for what learns from it.

`sight` says which pixels of it show a body.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EYE_M, AIM_M = (0.3, 0.0, 0.4), (0.0, 0.0, -0.2)
FOV_DEG = 90.0  # from top to bottom, and as wide
_RIGHT = (0.0, 1.0, 0.0)  # it faces the robot: image right is the robot's left


def camera_axes() -> NDArray[np.float64]:
    """The camera's right, up and back in the world, (3, 3): it looks along the last one's opposite."""
    back = (np.array(EYE_M) - np.array(AIM_M)) / np.linalg.norm(np.array(EYE_M) - np.array(AIM_M))
    return np.stack([_RIGHT, np.cross(back, _RIGHT), back])


def front_pixels(points_m: NDArray[np.floating], image_px: int) -> NDArray[np.float64]:
    """Row and column (n, 2) of world points (n, 3) in the front camera's square picture.

    A point may lie beside the picture; one that is not before the camera gives a place without meaning.
    """
    right, up, back = camera_axes() @ (np.asarray(points_m, np.float64) - np.array(EYE_M)).T
    focal_px = image_px / 2 / np.tan(np.deg2rad(FOV_DEG) / 2)
    return np.stack([image_px / 2 + focal_px * up / back, image_px / 2 - focal_px * right / back], axis=-1)
