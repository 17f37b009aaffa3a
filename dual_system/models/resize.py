"""Pictures resized where the network is, bit for bit as `images` does it on a CPU: two small matrix products.

torch's resize of bytes adds integers: weights times a power of two, rounded, first along the width, then along the
height, with a byte in between. So do these products, in a float type that holds every sum exactly. No kernel of torch
resizes bytes on a GPU.
"""

# V views, h w of a frame, Y X of the picture inside the square of P px

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models.images import PADDING, fitted_size

_WEIGHT_BITS = 15
"""torch keeps weights as int16, with as many bits behind the point as the largest one leaves."""
_MOST_BITS = 22
_FLOAT32_BITS = 16
"""With so many, 255 times weights that add up to one stays below 2**24."""


class Weights(NamedTuple):
    """A resize along one axis: whole numbers (out, in), and the number that makes one."""

    matrix: Tensor
    one: float


@lru_cache(maxsize=64)
def weights_of(size: int, new_size: int, device: torch.device) -> Weights:
    """Antialiased bilinear weights of torch's resize, as whole numbers."""
    impulses = torch.eye(size, dtype=torch.float64)[None, :, None]
    shares = F.interpolate(impulses, (1, new_size), mode="bilinear", antialias=True, align_corners=False)[0, :, 0].T
    most, bits = float(shares.max()), 0
    while bits < _MOST_BITS and int(0.5 + most * 2 ** (bits + 1)) < 2**_WEIGHT_BITS:
        bits += 1
    dtype = torch.float32 if bits <= _FLOAT32_BITS else torch.float64
    return Weights((0.5 + shares * 2**bits).floor().to(device, dtype), float(2**bits))


def resized_views(frames: Sequence[NDArray[np.uint8] | None], size_px: int, device: torch.device) -> Tensor:
    """Views (1, V, 3, P, P) float32 in [-1, 1] on ``device``, the bits of `images.camera_batch`; None is black.

    A frame travels as the bytes it has, through pinned memory if ``device`` is a GPU.
    """
    views = torch.full((len(frames), 3, size_px, size_px), PADDING, device=device)
    for view, frame in zip(views, frames, strict=True):
        if frame is not None:
            _place(view, _moved(frame, device), size_px)
    return views[None]


def _moved(frame: NDArray[np.uint8], device: torch.device) -> Tensor:
    # Copied: frames off the wire are read-only views of bytes, which torch warns about, and may have any strides.
    frame_hw3 = torch.from_numpy(np.array(frame, order="C"))
    if device.type != "cuda":
        return frame_hw3.to(device)
    return frame_hw3.pin_memory().to(device, non_blocking=True)


def _place(view_3PP: Tensor, frame_hw3: Tensor, size_px: int) -> None:
    """Writes a frame into the middle of a view."""
    height, width = frame_hw3.shape[:2]
    new_height, new_width = fitted_size(height, width, size_px)
    pixels_3hw = frame_hw3.permute(2, 0, 1)
    if (new_height, new_width) != (height, width):
        pixels_3hw = _along_last(pixels_3hw, new_width)
        pixels_3hw = _along_last(pixels_3hw.transpose(1, 2), new_height).transpose(1, 2)
    top, left = (size_px - new_height) // 2, (size_px - new_width) // 2
    view_3PP[:, top : top + new_height, left : left + new_width] = pixels_3hw.float() / 127.5 - 1.0


def _along_last(pixels: Tensor, new_size: int) -> Tensor:
    """Whole numbers of 0..255 along another number of places."""
    if pixels.shape[-1] == new_size:
        return pixels
    weights = weights_of(pixels.shape[-1], new_size, pixels.device)
    summed = pixels.to(weights.matrix.dtype) @ weights.matrix.T
    return (summed / weights.one + 0.5).floor().clamp(0, 255)
