"""Place encoding, and snapping a noisy one to the nearest valid one, for a POUNCE with ``rounds_places``.

The demo's PONDER is trained to encode a place in the 256 px picture in C as sines and cosines of both coordinates, with
periods from 512 px down to 16 px, followed by the coordinates themselves. A network that is unsure between two places
outputs the mean of their encodings, whose slow components point between the two; the nearest valid encoding is at the
likelier one.
"""

# F numbers of a code, N places along a side

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

PLACE_PX = 256
"""Side of the picture in whose pixels places are measured."""
_PERIODS = 2.0 ** np.arange(1, -5, -1)  # in picture sides
NUM_PLACE_FEATURES = 2 * (2 * len(_PERIODS) + 1)
_VALUE_SCALE = 2 * 3**0.5  # a coordinate is uniform in [-1/2, 1/2] at most: rms 1
_STEP_PX = 0.5


def place_features(yx_px: tuple[float, float]) -> NDArray[np.float32]:
    """Encodes a place in a 256 px picture as (NUM_PLACE_FEATURES,) float32, rms 1."""
    yx = np.array(yx_px, np.float64) / PLACE_PX
    angles = 2 * np.pi * np.outer(1 / _PERIODS, yx).ravel()
    waves = 2**0.5 * np.concatenate([np.sin(angles), np.cos(angles)])
    return np.concatenate([waves, (yx - 0.5) * _VALUE_SCALE]).astype(np.float32)


def snap_to_code(cognition: Tensor) -> Tensor:
    """Cognition (..., H) with its first NUM_PLACE_FEATURES numbers snapped to the nearest valid place encoding.

    Places are half a pixel apart. The gradient passes straight through, because rounding has none.

    Raises:
        ValueError: cognition has fewer numbers than a code.
    """
    if cognition.shape[-1] < NUM_PLACE_FEATURES:
        raise ValueError(f"a place's code is {NUM_PLACE_FEATURES} numbers, cognition has {cognition.shape[-1]}")
    numbers, rest = cognition.tensor_split([NUM_PLACE_FEATURES], dim=-1)
    codes_NF = _codes(numbers.device)
    found = torch.empty_like(numbers)
    for side in (0, 1):  # y and x are encoded separately
        own_N, own = codes_NF[:, side::2], numbers.detach()[..., side::2]
        found[..., side::2] = own_N[(own_N.square().sum(dim=1) - 2 * own @ own_N.T).argmin(dim=-1)]
    return torch.cat([numbers + (found - numbers).detach(), rest], dim=-1)


@functools.cache
def _codes(device: torch.device) -> Tensor:
    """Encodings (N, F) of the places on the picture's diagonal, which contain every y and every x."""
    along = np.arange(0, PLACE_PX, _STEP_PX)
    return torch.from_numpy(np.stack([place_features((px, px)) for px in along])).to(device)
