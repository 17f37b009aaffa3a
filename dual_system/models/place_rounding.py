"""Which place do numbers tell that are no place's code (`place_code`)? The one whose code is nearest.

A network can read a place off the slow numbers alone, and one that has only seen flawless codes does. But a network
that is not sure tells the mean of two places' codes: the slow numbers then lie between the two, where nothing is, and
the nearest code is at the likelier one.
"""

# F numbers of a code, N places along a side

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from dual_system.models.place_code import PLACE_PX, place_features

_STEP_PX = 0.5


def nearest_code(numbers: Tensor) -> Tensor:
    """The code nearest to ``numbers`` (..., NUM_PLACE_FEATURES) of all places in the picture, half a pixel apart.

    Backwards it is the identity (straight through): a code that is rounded has no slope of its own.
    """
    codes_NF = _codes(numbers.device)
    found = torch.empty_like(numbers)
    for side in (0, 1):  # y and x have numbers of their own
        own_N, own = codes_NF[:, side::2], numbers.detach()[..., side::2]
        found[..., side::2] = own_N[(own_N.square().sum(dim=1) - 2 * own @ own_N.T).argmin(dim=-1)]
    return numbers + (found - numbers).detach()


@functools.cache
def _codes(device: torch.device) -> Tensor:
    """Codes (N, F) of the places on the picture's diagonal: every y, and every x."""
    along = np.arange(0, PLACE_PX, _STEP_PX)
    return torch.from_numpy(np.stack([place_features((px, px)) for px in along])).to(device)
