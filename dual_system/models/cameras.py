"""The Panda's two cameras in numpy, as `arm` is its arm: where on the table a place of the front picture is, and where
in the wrist camera's picture.

The constants equal those of the simulator's scene (a test compares them). Frames: the table's (`arm`); a camera's has x
to the right, y down and z ahead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dual_system.models.arm import Array, Poses

_SHARE = 0.5  # of a picture's side a metre, at a metre's distance: both see 90 degrees
_FRONT_EYE_M = np.array([0.3, 0.0, 0.4])
_FRONT = np.array([[0.0, 1.0, 0.0], [2.0, 0.0, -1.0], [-1.0, 0.0, -2.0]]) / np.sqrt([[1.0], [5.0], [5.0]])
"""Its x, y and z in the table's frame."""
_WRIST_EYE_M = np.array([0.0465, -0.02, -0.0674])
_WRIST = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Its eye, and its x, y and z, in the tool's frame."""


def at_height(xy: ArrayLike, height_m: ArrayLike) -> Array:
    """Returns the points (..., 3) at heights (...) above the table that the front camera sees at ``xy`` (..., 2).

    ``xy``: column and row as fractions of the whole picture. A ray that does not come down there gives no finite point.
    """
    x, y = np.moveaxis(np.asarray(xy, dtype=np.float64), -1, 0)
    rays = np.stack([(x - 0.5) / _SHARE, (y - 0.5) / _SHARE, np.ones_like(x)], axis=-1) @ _FRONT
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (np.asarray(height_m)[..., None] - _FRONT_EYE_M[2]) / rays[..., 2:]
        return np.where(far > 0, _FRONT_EYE_M + far * rays, np.nan)


def in_wrist_picture(points_m: ArrayLike, tool: Poses) -> Array:
    """Returns row and column (..., 2), as fractions of the wrist camera's picture, of points (..., 3); NaN behind."""
    from_tool = np.einsum("...ji,...j->...i", tool.rotation, np.asarray(points_m) - tool.position_m)
    x, y, z = np.moveaxis((from_tool - _WRIST_EYE_M) @ _WRIST.T, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        placed = 0.5 + _SHARE * np.stack([y / z, x / z], axis=-1)
    return np.where(z[..., None] > 0, placed, np.nan)
