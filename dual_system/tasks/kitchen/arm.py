"""What scripts know of the robot: where its tool is, which way of several it reaches best, and how it gets home."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen import omron, steps
from dual_system.tasks.kitchen.predicates import View
from dual_system.tasks.kitchen.reach import UNREACHABLE, Base, Leg, Reach
from dual_system.tasks.kitchen.steps import SHUT, Step, Steps

_SAME_BASE_M = 0.02
_FREE = 0.1  # worth of a path that is taken without looking at others


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """One way to do something: where the base stands, and the poses (4, 4) that the tool comes through."""

    base: Base
    poses: tuple[Array, ...]
    joint: str = ""  # what the tool leads on the way
    values: tuple[float, ...] = ()  # of it, one a pose
    cost: float = 0.0  # taken off its worth


class Arm:
    """The Panda of a scene, as scripts plan with it."""

    def __init__(self, view: View) -> None:
        self.view = view
        self._reach = Reach(view)
        self._home, self._home_base = steps.here(view), self._reach.base()

    @property
    def base(self) -> Base:
        """Where the base stands."""
        return self._reach.base()

    def rate(self, ways: Sequence[Way], start: Array = omron.START_QPOS) -> tuple[float, int, Array]:
        """Returns how well the best of some ways is reached, which it is, and the joints (7,) at its end."""
        (best,) = self.rate_best(ways, 1, start)
        return best

    def rate_best(
        self, ways: Sequence[Way], num: int, start: Array = omron.START_QPOS
    ) -> list[tuple[float, int, Array]]:
        """Returns the same of the best few ways, best first; costs order them, but are not taken off."""
        ranked: list[tuple[float, float, int, Array]] = []
        for i, way in enumerate(ways):
            floor = ranked[num - 1][0] + way.cost if len(ranked) >= num else -np.inf
            worth, qpos = self._reach.worth(
                way.poses, way.base, joint=way.joint, values=way.values, start=start, floor=floor
            )
            ranked.append((worth - way.cost, worth, i, qpos))
            ranked.sort(key=lambda each: -each[0])
        return [(worth, i, qpos) for _, worth, i, qpos in ranked[:num]]

    def best(self, ways: Sequence[Way], num: int = 1) -> list[Way]:
        """Returns the few ways that are reached best, the best first. Raises UnreachableError if none is."""
        rated = [(worth, i) for worth, i, _ in self.rate_best(ways, num) if worth > UNREACHABLE]
        if not rated:
            raise UnreachableError(f"none of {len(ways)} ways is within the arm's reach; draw another scene")
        return [ways[i] for _, i in rated]

    def first_free(self, paths: Iterable[Sequence[Leg]], *, alike: float = 0.0) -> int:
        """Returns the first path that the hand follows from here without touching anything.

        If there is none, the best of all is returned, or the first that is worth no more than ``alike`` less.
        """
        rated: list[float] = []
        for i, path in enumerate(paths):
            rated.append(self._reach.follow(path, max(rated, default=-np.inf)))
            if rated[-1] > _FREE:
                return i
        return next(i for i, worth in enumerate(rated) if worth >= max(rated) - alike)

    def after_drive(self, T: Array, base: Base, start: Base | None = None) -> Array:
        """Returns a pose of the hand after it has ridden along to another place of the base."""
        ahead, left = start or self.base
        return steps.moved(T, [left - base[1], base[0] - ahead, 0.0])

    def go_home(self) -> Steps:
        """Brings the hand back to where it was at first, seen from the base."""
        home = self.after_drive(self._home, self.base, self._home_base)
        here = steps.here(self.view)
        turned = [steps.rotated_about_itself(home, turn) for turn in (0.0, np.pi, np.pi / 2, -np.pi / 2)]
        turned.append(steps.moved(here, home[:3, 3] - here[:3, 3]))  # or as it is
        paths = [path for T in turned for path in ((*steps.around(here, T), T), (T,))]
        for T in paths[self.first_free([Leg(base=self.base, poses=path)] for path in paths)]:
            yield Step(pose=T)

    def drive(self, base: Base, *, holds: str = "") -> Steps:
        """Moves the base to a place if it is not there; the hand rides along."""
        if max(abs(a - b) for a, b in zip(self.base, base, strict=True)) > _SAME_BASE_M:
            there = self.after_drive(steps.here(self.view), base)
            yield Step(pose=there, base_m=base, opening=SHUT, holds=holds)
