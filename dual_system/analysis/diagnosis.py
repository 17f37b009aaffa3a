"""Reads ``diagnosis.json`` of ``pp-diagnose`` and estimates its uncertainty.

Losses of one task are an (E, C) array: means over each episode's ticks in each of C conditions. Ticks of one episode
are not independent, so episodes are resampled, within their task (the paper's task-stratified bootstrap).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis.statistics import LEVEL, NUM_RESAMPLES, Interval
from protocol import files

DIAGNOSIS = "diagnosis.json"
SCHEMA = "ponderpounce-diagnosis/1"
FRESH_AGE_S = 0.3
CONDITIONS = ("real", "null", "shuffled")

Part = Literal["staleness", "all", "branch"]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Losses:
    """One part of a diagnosis.

    Attributes:
        names: names of the conditions.
        means: mean losses per task, (E, C).
        num_ticks: number of ticks in each mean, per task, (E,), at least 1.
    """

    names: tuple[str, ...]
    means: Mapping[str, Array]
    num_ticks: Mapping[str, Array]

    @property
    def total_ticks(self) -> int:
        return int(sum(each.sum() for each in self.num_ticks.values()))

    @property
    def num_episodes(self) -> int:
        return sum(len(each) for each in self.num_ticks.values())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """One pair of checkpoints over one set of episodes."""

    label: str
    parts: Mapping[Part, Losses]
    is_untrained: bool


def read_diagnosis(path: Path) -> Diagnosis:
    """Reads a diagnosis, or that of a folder.

    Raises:
        OSError, FileError: the file cannot be read, or is no diagnosis.
    """
    file = path / DIAGNOSIS if path.is_dir() else path
    kind = "diagnosis of pp-diagnose"
    found = files.read_json(file, kind)
    with files.reading(file, kind):
        if found["schema"] != SCHEMA:
            raise ValueError(f"schema {found['schema']!r}, expected {SCHEMA!r}")
        names = {"staleness": tuple(map(str, found["stale_by"])), "all": CONDITIONS, "branch": CONDITIONS}
        parts: dict[Part, Losses] = {part: _losses(found["episodes"], part, names[part]) for part in names}  # type: ignore[misc]
        is_untrained = any(model["is_untrained"] for model in found["models"].values())
    label = str(path.parent if path.name == DIAGNOSIS else path)
    return Diagnosis(label=label, parts=parts, is_untrained=is_untrained)


def absolute(losses: Losses, name: str) -> Interval:
    """Returns one condition's mean over all ticks. Raises ValueError if there are no ticks."""
    return _bootstrap(losses, losses.names.index(name), None)


def ratio(losses: Losses, name: str, to: str) -> Interval:
    """Returns the ratio of two conditions' means, resampled together. Raises ValueError if there are no ticks."""
    return _bootstrap(losses, losses.names.index(name), losses.names.index(to))


def _losses(episodes: Sequence[Mapping[str, Any]], part: str, names: tuple[str, ...]) -> Losses:
    counted = [episode for episode in episodes if episode[part]["num_ticks"]]
    tasks = sorted({episode["task"] for episode in counted})
    of = {task: [episode[part] for episode in counted if episode["task"] == task] for task in tasks}
    return Losses(
        names=names,
        means={task: np.array([[each["loss"][name] for name in names] for each in of[task]]) for task in tasks},
        num_ticks={task: np.array([float(each["num_ticks"]) for each in of[task]]) for task in tasks},
    )


def _bootstrap(losses: Losses, above: int, below: int | None) -> Interval:
    if not losses.num_ticks:
        raise ValueError("no tick to take a mean of; collect longer or more episodes")
    columns = [above] if below is None else [above, below]
    rng = np.random.default_rng(0)
    sums = np.zeros((NUM_RESAMPLES + 1, len(columns)))
    ticks = np.zeros(NUM_RESAMPLES + 1)
    for task, means_EC in losses.means.items():
        ticks_E = losses.num_ticks[task]
        count = len(ticks_E)
        drawn_BE = rng.multinomial(count, np.full(count, 1 / count), NUM_RESAMPLES)
        weights_BE = np.vstack([np.ones(count), drawn_BE]) * ticks_E  # the first row is the data itself
        sums += weights_BE @ means_EC[:, columns]
        ticks += weights_BE.sum(1)
    values = sums[:, 0] / (ticks if below is None else sums[:, 1])
    low, high = np.quantile(values[1:], ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(value=float(values[0]), low=float(low), high=float(high))
