"""The paper's Figure 4 for own checkpoints: loss over cognition's age, as one PNG drawn with Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

from dual_system.analysis.diagnosis import FRESH_AGE_S, Diagnosis, ratio

WIDTH_PX, HEIGHT_PX, LEFT_PX, MARGIN_PX = 720, 440, 60, 40
_COLOURS = ((24, 84, 160), (190, 80, 20), (40, 130, 60), (120, 60, 150), (90, 90, 90))
_INK, _GRID = (40, 40, 40), (225, 225, 225)


def plot_staleness(diagnoses: Sequence[Diagnosis], png: Path) -> None:
    """Draws each diagnosis' loss at growing ages relative to its loss at 0.3 s, on a log2 axis, with a 95 % band.

    Raises:
        ValueError: a diagnosis has no ticks.
    """
    curves = []
    for each in diagnoses:
        losses = each.parts["staleness"]
        ages_s = [FRESH_AGE_S + float(name) for name in losses.names]
        curves.append((each.label, ages_s, [ratio(losses, name, losses.names[0]) for name in losses.names]))
    ends = [bound for _, _, points in curves for point in points for bound in (point.low, point.high)]
    low, high = math.floor(math.log2(min(ends))), math.ceil(math.log2(max(ends)))
    high = max(high, low + 1)
    longest_s = max(ages_s[-1] for _, ages_s, _ in curves)
    image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "white")
    draw = ImageDraw.Draw(image, "RGBA")

    def at(age_s: float, value: float) -> tuple[float, float]:
        x_px = LEFT_PX + age_s / longest_s * (WIDTH_PX - LEFT_PX - MARGIN_PX)
        share = (math.log2(value) - low) / (high - low)
        return x_px, HEIGHT_PX - MARGIN_PX - share * (HEIGHT_PX - 2 * MARGIN_PX)

    for power in range(low, high + 1):
        draw.line([at(0, 2.0**power), at(longest_s, 2.0**power)], fill=_GRID)
        draw.text((8, at(0, 2.0**power)[1] - 6), f"{2.0**power:g}x", fill=_INK)
    for age_s in curves[0][1]:
        draw.text((at(age_s, 2.0**low)[0] - 8, HEIGHT_PX - MARGIN_PX + 6), f"{age_s:.1f}", fill=_INK)
    draw.text((LEFT_PX, HEIGHT_PX - 16), "age of cognition [s]; flow-matching loss over that at 0.3 s, 95 %", fill=_INK)
    for number, (label, ages_s, points) in enumerate(curves):
        colour = _COLOURS[number % len(_COLOURS)]
        upper = [at(age_s, point.high) for age_s, point in zip(ages_s, points, strict=True)]
        lower = [at(age_s, point.low) for age_s, point in zip(ages_s, points, strict=True)]
        draw.polygon([*upper, *reversed(lower)], fill=(*colour, 50))
        draw.line([at(age_s, point.value) for age_s, point in zip(ages_s, points, strict=True)], fill=colour, width=2)
        draw.text((LEFT_PX + 10, 8 + 14 * number), label, fill=colour)
    image.save(png)
