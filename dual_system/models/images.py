"""Camera frames to network pixels: resize with the aspect ratio kept, pad to a square, scale to [-1, 1]."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

PADDING = -1.0
"""Black; also every pixel of a missing camera."""


def resize_with_pad(frame: NDArray[np.uint8], size_px: int) -> Tensor:
    """(h, w, 3) uint8 -> (3, size_px, size_px) float32 in [-1, 1], centred on black.

    Bilinear with antialiasing on uint8, like the PIL resize of openpi's data path and client. lerobot
    interpolates floats without antialiasing, which differs wherever a frame shrinks.
    """
    pixels = _resized(frame, size_px)
    height_px, width_px = pixels.shape[1:]
    image = torch.full((3, size_px, size_px), PADDING)
    top_px, left_px = (size_px - height_px) // 2, (size_px - width_px) // 2
    image[:, top_px : top_px + height_px, left_px : left_px + width_px] = pixels.float() / 127.5 - 1.0
    return image


def resized(frame: NDArray[np.uint8], size_px: int) -> NDArray[np.uint8]:
    """Returns (h, w, 3) uint8 with the longer side scaled to ``size_px``; `resize_with_pad` gives the same for both."""
    return _resized(frame, size_px).permute(1, 2, 0).contiguous().numpy()


def fitted_size(height_px: int, width_px: int, size_px: int) -> tuple[int, int]:
    """Height and width with the longer side scaled to ``size_px``."""
    longest_px = max(height_px, width_px)
    return max(1, height_px * size_px // longest_px), max(1, width_px * size_px // longest_px)


def _resized(frame: NDArray[np.uint8], size_px: int) -> Tensor:
    """Returns (3, h, w) uint8."""
    height_px, width_px = frame.shape[:2]
    new_height_px, new_width_px = fitted_size(height_px, width_px, size_px)
    # Copied: frames off the wire are read-only views of bytes, which torch warns about, and may have any strides.
    pixels = torch.from_numpy(np.array(frame, order="C")).permute(2, 0, 1)
    if (new_height_px, new_width_px) == (height_px, width_px):
        return pixels
    return F.interpolate(
        pixels[None], (new_height_px, new_width_px), mode="bilinear", antialias=True, align_corners=False
    )[0]


def camera_batch(frames: Sequence[NDArray[np.uint8] | None], size_px: int) -> tuple[Tensor, Tensor]:
    """Returns one observation's views, (1, V, 3, px, px), and which cameras were not None, (1, V) bool."""
    if not frames:
        return torch.empty(1, 0, 3, size_px, size_px), torch.empty(1, 0, dtype=torch.bool)
    missing = torch.full((3, size_px, size_px), PADDING)
    views = [missing if frame is None else resize_with_pad(frame, size_px) for frame in frames]
    has_view = [frame is not None for frame in frames]
    return torch.stack(views)[None], torch.tensor(has_view)[None]
