"""Plots a run's losses and gradient norm over its steps, as one PNG drawn with Pillow."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

WIDTH_PX, PANEL_PX, MARGIN_PX, LEFT_PX = 900, 220, 28, 70
_CURVES = (
    ("total", "loss"),
    ("flow_matching", "flow matching"),
    ("grounding", "grounding"),
    ("gradient_norm", "gradient norm"),
)
_RAW, _SMOOTH, _INK, _GRID = (176, 204, 235), (24, 84, 160), (40, 40, 40), (225, 225, 225)
_SMOOTHING = 0.95


def plot_log(log: Path, png: Path) -> None:
    """Draws ``log.jsonl``: a panel per curve, single steps pale and their running mean dark, on a logarithmic scale.

    A curve that is zero throughout (a recipe without texts) or missing from an older log is left out.

    Raises:
        ValueError: the log has no steps.
    """
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    if not lines:
        raise ValueError(f"{log} has no steps to draw")
    shown = [(key, title) for key, title in _CURVES if any(line.get(key, 0.0) > 0 for line in lines)]
    image = Image.new("RGB", (WIDTH_PX, PANEL_PX * len(shown)), "white")
    draw = ImageDraw.Draw(image)
    for place, (key, title) in enumerate(shown):
        _panel(draw, place * PANEL_PX, title, lines, key)
    image.save(png)


def smoothed(values: Iterable[float]) -> NDArray[np.float64]:
    """Exponential moving average, bias-corrected as in Adam."""
    mean, weight, out = 0.0, 0.0, []
    for value in values:
        mean = _SMOOTHING * mean + (1 - _SMOOTHING) * value
        weight = _SMOOTHING * weight + (1 - _SMOOTHING)
        out.append(mean / weight)
    return np.asarray(out)


def _panel(draw: ImageDraw.ImageDraw, top_px: int, title: str, lines: Sequence[Mapping[str, float]], key: str) -> None:
    steps = np.asarray([line["step"] for line in lines], np.float64)
    values = np.asarray([line[key] for line in lines], np.float64)
    low, high = _decades(values[values > 0])
    floor = 10.0**low
    x_px = LEFT_PX + (steps - steps[0]) / max(1.0, steps[-1] - steps[0]) * (WIDTH_PX - LEFT_PX - MARGIN_PX)
    bottom_px, height_px = top_px + PANEL_PX - MARGIN_PX, PANEL_PX - 2 * MARGIN_PX

    def y_px(curve: NDArray[np.float64]) -> NDArray[np.float64]:
        return bottom_px - (np.log10(np.maximum(curve, floor)) - low) / (high - low) * height_px

    for decade in range(low, high + 1):
        line_px = float(y_px(np.asarray([10.0**decade]))[0])
        draw.line([(LEFT_PX, line_px), (WIDTH_PX - MARGIN_PX, line_px)], fill=_GRID)
        draw.text((8, line_px - 6), f"{10.0**decade:g}", fill=_INK)
    draw.text((LEFT_PX, top_px + 8), f"{title}: {smoothed(values)[-1]:.4g} at step {int(steps[-1])}", fill=_INK)
    for curve, colour, width in ((values, _RAW, 1), (smoothed(values), _SMOOTH, 2)):
        points = list(zip(x_px.tolist(), y_px(curve).tolist(), strict=True))
        draw.line(points if len(points) > 1 else points * 2, fill=colour, width=width)


def _decades(positive: NDArray[np.float64]) -> tuple[int, int]:
    """Powers of ten around all values, at least one apart."""
    low = math.floor(math.log10(float(positive.min())))
    return low, max(low + 1, math.ceil(math.log10(float(positive.max()))))
