"""Statistics of columns and pictures, in the shape that LeRobot v3 stores: min, max, mean, std, count, quantiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Statistics = dict[str, list[Any]]


def of_vectors(values: NDArray[Any]) -> Statistics:
    """Statistics of (N, D) or (N,) numbers or truths, per dimension; all zero, with a count of 0, of nothing."""
    count = len(values)
    table = np.asarray(values, np.float64).reshape(count, values.shape[1] if values.ndim == 2 else 1)
    table = table if count else np.zeros((1, table.shape[1]))
    found = {"min": table.min(0), "max": table.max(0), "mean": table.mean(0), "std": table.std(0)}
    found |= {name: np.quantile(table, q, axis=0) for name, q in QUANTILES.items()}
    return {**{name: column.tolist() for name, column in found.items()}, "count": [count]}


class PixelHistogram:
    """Counts the values of each colour, so that statistics of any number of pictures are exact and can be added up."""

    def __init__(self, counts: NDArray[np.int64] | None = None, num_frames: int = 0) -> None:
        self.counts = np.zeros((3, 256), np.int64) if counts is None else counts
        self.num_frames = num_frames

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Counts a picture (height, width, 3)."""
        self.counts += [np.bincount(frame[..., colour].ravel(), minlength=256) for colour in range(3)]
        self.num_frames += 1

    def __add__(self, other: PixelHistogram) -> PixelHistogram:
        return PixelHistogram(self.counts + other.counts, self.num_frames + other.num_frames)

    def statistics(self) -> Statistics:
        """Per colour, of values in [0, 1], as nested lists (3, 1, 1); ``count`` is the number of pictures."""
        levels = np.arange(256) / 255
        share = self.counts / np.maximum(self.counts.sum(1, keepdims=True), 1)
        mean = share @ levels
        cumulative = np.cumsum(share, axis=1)
        found = {
            "min": levels[(self.counts > 0).argmax(1)],
            "max": levels[255 - (self.counts[:, ::-1] > 0).argmax(1)],
            "mean": mean,
            "std": np.sqrt((share * (levels - mean[:, None]) ** 2).sum(1)),
            **{name: levels[(cumulative >= q - 1e-12).argmax(1)] for name, q in QUANTILES.items()},
        }
        return {
            **{name: column.reshape(3, 1, 1).tolist() for name, column in found.items()},
            "count": [self.num_frames],
        }
