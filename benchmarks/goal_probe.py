"""Whether the start of a goal set tells its goal: a linear classifier on first frame and state, beside chance.

It is ridge regression on the pooled pixels of the three views and the 53 numbers, and on those alone, judged on scenes
that it was not fitted to. The start is drawn before the goal, so whatever it finds beyond chance is a defect of ours.
Intervals are of 99.5 %: six sets at chance, each probed twice, then show one above it in three of a hundred runs.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco
from benchmarks.report import Row, lines_of
from dual_system.analysis.markdown import percent
from dual_system.analysis.probe import predicted
from dual_system.analysis.statistics import wilson
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.kitchen.layout import NUM_STATE
from dual_system.tasks.seeds import scenes
from dual_system.tasks.task import TaskError
from protocol.command_line import command, parse

Floats = NDArray[np.float64]
_POOLED = 8  # a view's height and width
LEVEL = 0.995


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOptions:
    """Probes the starts of goal sets for their goals."""

    sets: tuple[str, ...] = tuple(GOAL_SETS)
    """Names of the goal sets."""
    scenes: int = 400
    """Number of scenes a set."""
    split: Literal["demo", "development"] = "demo"
    """Split of the scenes. demo: the objects' instances A; development: B."""


def seen_at_first(environment: KitchenEnvironment, seed: int, goal: int | None = None) -> tuple[Floats, int]:
    """Returns pooled pixels and state of a scene's start, and its goal: the seed's, or a given one."""
    first = environment.reset(seed, goal=goal)
    views = [_pooled(np.asarray(picture, np.float64)).ravel() for picture in first.frames.values()]
    return np.concatenate([*views, first.state.astype(np.float64)]), environment.scene.goal


def is_found(seen_NF: Floats, goals_N: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns for each scene whether the classifier that was fitted to the others' folds names its goal."""
    named_N = predicted(seen_NF, np.eye(int(goals_N.max()) + 1)[goals_N], np.arange(len(goals_N))).argmax(axis=1)
    found_N: NDArray[np.bool_] = named_N == goals_N
    return found_N


def _pooled(picture_HWC: Floats) -> Floats:
    height, width, channels = picture_HWC.shape
    return picture_HWC.reshape(_POOLED, height // _POOLED, _POOLED, width // _POOLED, channels).mean((1, 3))


def row_of(name: str, seen_NF: Floats, goals_N: NDArray[np.int64], num_goals: int) -> Row:
    """Returns a set's row."""
    found = [is_found(seen_NF[:, columns], goals_N) for columns in (slice(None), slice(-NUM_STATE, None))]
    both, state = (wilson(float(found_N.mean()), len(found_N), LEVEL) for found_N in found)
    return {
        "set": name,
        "scenes": len(goals_N),
        "frame and state, % [99.5 %]": percent(both),
        "state, % [99.5 %]": percent(state),
        "chance, %": round(100 / num_goals, 1),
        "above chance": "yes" if max(both.low, state.low) > 1 / num_goals else "no",
    }


def probed(name: str, seeds: range) -> Row:
    """Draws a set's scenes and returns its row."""
    with KitchenEnvironment(name) as environment:
        seen, goals = zip(*(seen_at_first(environment, seed) for seed in seeds), strict=True)
    return row_of(name, np.array(seen), np.array(goals), len(GOAL_SETS[name].choices))


@command("goal-probe")
def main(argv: list[str] | None = None) -> int:
    options = parse(ProbeOptions, argv, prog="goal-probe")
    if unknown := [name for name in options.sets if name not in GOAL_SETS]:
        raise TaskError(f"unknown goal set {unknown[0]!r}; expected {', '.join(GOAL_SETS)}")
    seeds = scenes(options.scenes, split=options.split)
    rows = [probed(name, seeds) for name in dict.fromkeys(options.sets)]
    print("\n".join(lines_of(rows)))
    return int(any(row["above chance"] == "yes" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
