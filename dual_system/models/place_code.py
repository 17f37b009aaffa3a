"""Places as numbers: the form in which cognition of our small networks tells where something is.

Sines and cosines of both coordinates from 512 px, two pictures, down to 16 px, then the coordinates themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PLACE_PX = 256
"""Side of the picture that places are counted in, upstream's."""
_PERIODS = 2.0 ** np.arange(1, -5, -1)  # of the picture's side
WAVE_PX = tuple(round(period * PLACE_PX) for period in _PERIODS)
NUM_PLACE_FEATURES = 2 * (2 * len(_PERIODS) + 1)
VALUE_SCALE = 2 * 3**0.5  # a coordinate is uniform in [-1/2, 1/2] at most: rms 1


def place_features(yx_px: tuple[float, float]) -> NDArray[np.float32]:
    """A place in a 256 px picture as (NUM_PLACE_FEATURES,) numbers, rms 1."""
    yx = np.array(yx_px, np.float64) / PLACE_PX
    angles = 2 * np.pi * np.outer(1 / _PERIODS, yx).ravel()
    waves = 2**0.5 * np.concatenate([np.sin(angles), np.cos(angles)])
    return np.concatenate([waves, (yx - 0.5) * VALUE_SCALE]).astype(np.float32)


def wave_columns(period_px: int) -> list[int]:
    """Which of `place_features` turn once in so many pixels: sine and cosine of y and x. Raises ValueError if none."""
    first = 2 * WAVE_PX.index(period_px)
    return [first, first + 1, first + 2 * len(_PERIODS), first + 1 + 2 * len(_PERIODS)]
