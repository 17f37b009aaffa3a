"""Success rates with their uncertainty, over tasks, scenes and runs. Pure functions of zeros and ones.

Outcomes of one task are an (R, E) array: R runs over the same E scenes, 1 where the episode succeeded. Episodes of one
scene are not independent, so scenes are resampled together with all their runs. Whole runs are resampled too, because
there are few. Tasks are not, because the suite is fixed (the paper's task-stratified bootstrap).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

LEVEL = 0.95
NUM_RESAMPLES = 10_000

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """An estimate and its confidence interval, as fractions."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """Two conditions over the same scenes: the second minus the first."""

    difference: Interval
    num_better: int  # scenes, by their mean over runs
    num_worse: int
    p_value: float  # exact sign test, two-sided


def success_rate(tasks: Sequence[ArrayLike]) -> float:
    """Returns the mean over tasks of their mean over scenes and runs. Raises ValueError as `bootstrap` does."""
    return float(np.mean([outcomes.mean() for outcomes in _checked(tasks)]))


def wilson(rate: float, num_trials: int, level: float = LEVEL) -> Interval:
    """Returns Wilson's score interval of one task's rate; unlike the bootstrap's it has a width at 0 and 1 too.

    Args:
        rate: fraction of successes; a mean over runs of one set of scenes need not be a multiple of 1/num_trials.
        num_trials: number of independent trials. That is the number of scenes, whatever the number of runs, so that
            the interval is never too narrow.

    Raises ValueError if there are no trials, or the rate is no fraction.
    """
    if num_trials < 1 or not 0 <= rate <= 1:
        raise ValueError(f"expected a rate in [0, 1] of at least one trial; got {rate} of {num_trials}")
    z2 = NormalDist().inv_cdf((1 + level) / 2) ** 2 / num_trials
    centre = (rate + z2 / 2) / (1 + z2)
    half = math.sqrt(rate * (1 - rate) * z2 + z2**2 / 4) / (1 + z2)
    return Interval(value=rate, low=max(0.0, min(rate, centre - half)), high=min(1.0, max(rate, centre + half)))


def bootstrap(
    tasks: Sequence[ArrayLike], *, level: float = LEVEL, num_resamples: int = NUM_RESAMPLES, seed: int = 0
) -> Interval:
    """Returns the mean over tasks with its task-stratified percentile interval.

    Args:
        tasks: (R, E) outcomes of each task; R must be equal in all tasks, E need not be.

    Raises ValueError if there are no outcomes, values other than 0 and 1, or tasks with different numbers of runs.
    """
    outcomes = _checked(tasks)
    rng = np.random.default_rng(seed)
    means = _resampled(outcomes, _drawn_runs(len(outcomes[0]), num_resamples, rng), rng)
    return _interval(success_rate(outcomes), means, level)


def bootstrap_mean(values: ArrayLike, *, level: float = LEVEL, num_resamples: int = NUM_RESAMPLES) -> Interval:
    """Returns the mean of independent values (N,) with its percentile interval. Raises ValueError if there are none."""
    values_N = np.asarray(values, np.float64)
    if values_N.ndim != 1 or not values_N.size:
        raise ValueError(f"expected values (N,), at least one; got shape {values_N.shape}")
    drawn_BN = np.random.default_rng(0).multinomial(
        values_N.size, np.full(values_N.size, 1 / values_N.size), num_resamples
    )
    return _interval(float(values_N.mean()), drawn_BN @ values_N / values_N.size, level)


def paired(
    first: Sequence[ArrayLike],
    second: Sequence[ArrayLike],
    *,
    level: float = LEVEL,
    num_resamples: int = NUM_RESAMPLES,
    seed: int = 0,
) -> Paired:
    """Returns the second condition's gain over the first, scene by scene.

    Args:
        first, second: as in `bootstrap`, with the same tasks and scenes in the same order. Runs are not paired, and
            their numbers may differ.

    Raises ValueError as `bootstrap` does, or if scenes do not match.
    """
    befores, afters = _checked(first), _checked(second)
    if [before.shape[1] for before in befores] != [after.shape[1] for after in afters]:
        raise ValueError("paired differences need the same scenes of the same tasks in both conditions")
    rng = np.random.default_rng(seed)
    weights = np.hstack(
        [-_drawn_runs(len(befores[0]), num_resamples, rng), _drawn_runs(len(afters[0]), num_resamples, rng)]
    )
    stacked = [np.vstack(both) for both in zip(befores, afters, strict=True)]
    pairs = list(zip(befores, afters, strict=True))
    gains = np.concatenate([_whole_gains(before, after) for before, after in pairs])
    num_better, num_worse = int((gains > 0).sum()), int((gains < 0).sum())
    return Paired(
        difference=_interval(success_rate(afters) - success_rate(befores), _resampled(stacked, weights, rng), level),
        num_better=num_better,
        num_worse=num_worse,
        p_value=sign_test(num_better, num_worse),
    )


def sign_test(num_better: int, num_worse: int) -> float:
    """Returns the exact two-sided p-value of these counts if both signs are equally likely; leave ties out."""
    num_signs, fewer = num_better + num_worse, min(num_better, num_worse)
    return min(1.0, 2 * sum(math.comb(num_signs, k) for k in range(fewer + 1)) / 2**num_signs)


def _checked(tasks: Sequence[ArrayLike]) -> list[Array]:
    outcomes = [np.asarray(task, np.float64) for task in tasks]
    if not outcomes or any(each.ndim != 2 or not each.size for each in outcomes):
        raise ValueError(f"expected outcomes (R, E) of at least one task; got {[each.shape for each in outcomes]}")
    if len({len(each) for each in outcomes}) > 1:
        raise ValueError(f"expected as many runs of every task; got {[len(each) for each in outcomes]}")
    if not all(np.isin(each, (0, 1)).all() for each in outcomes):
        raise ValueError("outcomes must be 0 or 1")
    return outcomes


def _whole_gains(before: Array, after: Array) -> Array:
    """(E,): integers with the sign of each scene's gain; with floats, 2/3 - 4/6 need not be 0."""
    return len(before) * after.sum(0) - len(after) * before.sum(0)


def _drawn_runs(num_runs: int, num_resamples: int, rng: np.random.Generator) -> Array:
    """(B, R): weight of each run in each resample. A run covers the whole suite, so all tasks share the draw."""
    return rng.multinomial(num_runs, np.full(num_runs, 1 / num_runs), num_resamples) / num_runs


def _resampled(tasks: Sequence[Array], weights_BR: Array, rng: np.random.Generator) -> Array:
    """(B,): means over tasks of resampled scenes. Scenes with equal outcomes are interchangeable, so counts are drawn.

    So the order of scenes does not matter, and a resample costs at most 2^R numbers for any number of scenes.
    """
    means = np.zeros(len(weights_BR))
    for outcomes_RE in tasks:
        patterns_RU, counts = np.unique(outcomes_RE, axis=1, return_counts=True)
        num_scenes = outcomes_RE.shape[1]
        drawn_BU = rng.multinomial(num_scenes, counts / num_scenes, len(weights_BR)) / num_scenes
        means += ((weights_BR @ patterns_RU) * drawn_BU).sum(1)
    return means / len(tasks)


def _interval(value: float, resampled: Array, level: float) -> Interval:
    low, high = np.quantile(resampled, ((1 - level) / 2, (1 + level) / 2))
    return Interval(value=value, low=float(low), high=float(high))
