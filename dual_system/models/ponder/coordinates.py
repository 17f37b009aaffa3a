"""Grounded coordinates: ``<y, x>`` in image pixels to normalised ``[x, y]`` in 0..1000, and back.

PONDER's pretrained grounding uses normalised [x, y] in 0..1000; the simulator's templates use <y, x> pixels of a
256 px image (paper, appendix A.2). Both directions round half up in integers, so no token depends on a platform's
floats. Because 1000 > 256, pixels -> normalised -> pixels is the identity for images of up to 1000 px.
"""

import re

YX_PX = re.compile(r"<\s*(\d+)\s*,\s*(\d+)\s*>")
XY_1000 = re.compile(r"\[\s*(\d+)\s*,\s*(\d+)\s*\]")
TEXT_PX = 256
"""Side of the picture whose pixels the tasks' texts name."""
_PIXELS = range(TEXT_PX + 1)  # its far edge included


def _scaled(value: int, numerator: int, denominator: int) -> int:
    return (2 * value * numerator + denominator) // (2 * denominator)


def xy_1000_from_yx_px(yx_px: tuple[int, int], image_px: tuple[int, int] = (TEXT_PX, TEXT_PX)) -> tuple[int, int]:
    """``(y, x)`` pixels of a (height, width) image as ``(x, y)`` in 0..1000. ValueError if outside."""
    (y, x), (height, width) = yx_px, image_px
    if not (0 <= y <= height and 0 <= x <= width):
        raise ValueError(f"<y, x> = <{y}, {x}> lies outside the {height} x {width} px image")
    return _scaled(x, 1000, width), _scaled(y, 1000, height)


def yx_px_from_xy_1000(xy_1000: tuple[int, int], image_px: tuple[int, int] = (TEXT_PX, TEXT_PX)) -> tuple[int, int]:
    """Inverse of :func:`xy_1000_from_yx_px`; the nearest pixel. ValueError if outside 0..1000."""
    (x, y), (height, width) = xy_1000, image_px
    if not (0 <= x <= 1000 and 0 <= y <= 1000):
        raise ValueError(f"[x, y] = [{x}, {y}] lies outside 0..1000")
    return _scaled(y, height, 1000), _scaled(x, width, 1000)


def normalised_text(text: str, image_px: tuple[int, int] = (TEXT_PX, TEXT_PX)) -> str:
    """Rewrites every ``<y, x>`` in ``text`` as ``[x, y]``, the form that PONDER is trained to generate."""

    def rewrite(match: re.Match[str]) -> str:
        x, y = xy_1000_from_yx_px((int(match[1]), int(match[2])), image_px)
        return f"[{x}, {y}]"

    return YX_PX.sub(rewrite, text)


PLACE_WORDS = (
    *(f" [{_scaled(px, 1000, TEXT_PX)}," for px in _PIXELS),
    *(f" {_scaled(px, 1000, TEXT_PX)}]" for px in _PIXELS),
)
"""Both halves of every `` [x, y]`` that a 256 px image has. A tokenizer of a network from scratch has a token for each:
spelled in digits, a place is a sum that a small network does not learn."""


def without_places(text: str) -> str:
    """The plain reading of a grounded text: every " at [x, y]" left out."""
    return re.sub(r" at " + XY_1000.pattern, "", text)


def moved_places(text: str, by_xy_px: tuple[int, int], image_px: tuple[int, int] = (TEXT_PX, TEXT_PX)) -> str:
    """The text with every ``[x, y]`` moved by pixels, kept within the image."""
    height, width = image_px

    def rewrite(match: re.Match[str]) -> str:
        y, x = yx_px_from_xy_1000((int(match[1]), int(match[2])), image_px)
        moved = min(max(y + by_xy_px[1], 0), height), min(max(x + by_xy_px[0], 0), width)
        return "[{}, {}]".format(*xy_1000_from_yx_px(moved, image_px))

    return XY_1000.sub(rewrite, text)
