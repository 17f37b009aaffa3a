"""Shoves: while the hand approaches an object, that object, or one that is wanted later, is pushed aside.

The object is then not where the subgoal or memory has it, as after a grasp that pushed it. Policies push objects in one
episode of three; an oracle's data hardly ever show it. The oracle has to track objects (`Motions`, ``watches``), and
texts to follow them (`make_environment`, ``texts_follow``). An episode's shoves are a function of its seed alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.physics import CONTROL_HZ, Physics
from dual_system.tasks.task import Subtask

_SHOVE_STREAM = 5  # of a seed's random numbers; the scene, failed grasps, noise and corrections draw from others
_DRAWS = 20  # of a free place; none found: nothing is moved


@dataclass(frozen=True, slots=True, kw_only=True)
class ShoveConfig:
    """When and how far objects are pushed."""

    mean_wait_s: float = 1.5
    """Mean time from a subtask's begin to its shove; a subtask has at most one, and a short one may have none."""
    least_m: float = 0.015
    most_m: float = 0.07
    """Distances are drawn log-uniformly between the two."""
    most_turned_rad: float = 0.8
    free_m: float = 0.055
    """Distance from the centre of any other object to the pushed one's new place; cubes have a side of 4 cm."""
    tool_above_m: float = 0.125
    """Least height of the tool above the object; a grasp waits at 0.13 m before it comes down."""
    later_share: float = 0.25
    """Share of shoves that move an object wanted later, if there is one."""

    def settings(self, share: float) -> dict[str, Any]:
        """Returns what a dataset records of it."""
        return {"share": share, **asdict(self)}


SHOVES = ShoveConfig()


def is_shoved(seed: int, share: float) -> bool:
    """Returns whether an episode is among the share that has shoves."""
    return bool(np.random.default_rng((seed, _SHOVE_STREAM)).random() < share)


class Shoves:
    """The shoves of one episode. Call `step` once per control step, before the step."""

    def __init__(self, physics: Physics, subtasks: Sequence[Subtask], seed: int, config: ShoveConfig = SHOVES) -> None:
        self._rng = np.random.default_rng((seed, _SHOVE_STREAM))
        self._rng.random()  # `is_shoved` has used the first
        self._physics, self._config = physics, config
        self._wanted = [[body for body in each.grounds if physics.is_free(body)] for each in subtasks]
        self._done: set[int] = set()
        self.num_shoved = 0

    def step(self, index: int) -> None:
        """Pushes an object aside, or nothing, during the subtask of this index."""
        happens = self._rng.random() < 1 / (self._config.mean_wait_s * CONTROL_HZ)
        if not happens or index in self._done or not self._wanted[index]:
            return
        body = self._chosen(index)
        tool_above_m = self._physics.tcp_transform()[2, 3] - self._physics.position_m(body)[2]
        if tool_above_m < self._config.tool_above_m or self._physics.is_grasped(body):
            return
        place = moved_aside(self._physics, body, self._rng, self._config)
        if place is None:
            return
        self._physics.place(body, place)
        self._physics.refresh()
        self._done.add(index)
        self.num_shoved += 1

    def _chosen(self, index: int) -> str:
        later = [body for bodies in self._wanted[index + 1 :] for body in bodies if body not in self._wanted[index]]
        if later and self._rng.random() < self._config.later_share:
            return str(self._rng.choice(later))
        return str(self._rng.choice(self._wanted[index]))


def moved_aside(physics: Physics, body: str, rng: np.random.Generator, config: ShoveConfig = SHOVES) -> Array | None:
    """Returns a body's pose (7,) moved aside and turned, clear of all other objects; None if no room was found."""
    here = physics.pose(body)
    others_m = np.array([physics.position_m(each)[:2] for each in physics.props if each != body]).reshape(-1, 2)
    for _ in range(_DRAWS):
        way, far_m = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(*np.log((config.least_m, config.most_m))))
        place = here.copy()
        place[:2] += far_m * np.array([np.cos(way), np.sin(way)])
        place[3:] = _turned(here[3:], rng.uniform(-1, 1) * config.most_turned_rad)
        if np.linalg.norm(others_m - place[:2], axis=1).min(initial=np.inf) >= config.free_m:
            return place
    return None


def _turned(wxyz: Array, by_rad: float) -> Array:
    """Returns a quaternion (4,) turned about the vertical."""
    w, x, y, z = wxyz
    c, s = np.cos(by_rad / 2), np.sin(by_rad / 2)
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
