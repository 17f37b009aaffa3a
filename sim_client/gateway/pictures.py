"""Pictures from clients: decoded lazily, checked against their announced size and each other, resized on request.

PONDER reads one frame in twenty of a video at 20 Hz; the others are never decoded.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from protocol.checks import MAX_IMAGE_SIDE_PX
from protocol.images import claimed_size
from sim_client.gateway.exchange import Frames, Refused


@dataclass(frozen=True, slots=True)
class EncodedPicture:
    """A PNG or JPEG as received, and its announced shape."""

    format: str
    data: bytes
    shape: tuple[int, ...]

    def decode(self) -> NDArray[np.uint8]:
        """Pixels (height, width, 3) uint8 RGB.

        Raises:
            Refused: the bytes are not the picture that was announced.
        """
        height, width, *_ = *self.shape, 0, 0
        if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX):
            raise Refused(f"a picture of shape {self.shape}: expected sides of 1 to {MAX_IMAGE_SIDE_PX} px")
        try:
            claimed_size(self.data)  # and a JPEG may have scans without end
            with Image.open(io.BytesIO(self.data), formats=("PNG", "JPEG")) as picture:
                if picture.size != (width, height):  # before memory is taken: a few bytes can claim gigabytes
                    came = f"{picture.size[1]} x {picture.size[0]}"
                    raise Refused(f"a picture that claims {height} x {width} px holds {came} px")
                return np.asarray(picture.convert("RGB"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise Refused(f"a picture that cannot be read as {self.format}: {error}") from None


def resized(frames: Frames, side_px: int | None) -> Frames:
    """The frames resized bilinearly to squares of ``side_px``; unchanged if it is None or if they fit."""
    if side_px is None:
        return frames
    return {name: _resized(frame, side_px) for name, frame in frames.items()}


def _resized(frame: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    if frame.shape[:2] == (side_px, side_px):
        return frame
    return np.asarray(Image.fromarray(frame).resize((side_px, side_px), Image.Resampling.BILINEAR))


def check_size(frames: Frames, size: tuple[int, int], reason: str) -> None:
    """Raises Refused: a picture is not of ``size``, height and width in px."""
    for camera, frame in frames.items():
        if frame.shape[:2] != size:
            expected, came = (f"{height} x {width}" for height, width in (size, frame.shape[:2]))
            raise Refused(f"{camera}: expected {expected} px {reason}, came {came}. See --image-px.")
