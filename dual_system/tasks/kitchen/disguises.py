"""Kitchens that show another demonstration, or none, to ask what a policy takes from it: controls of an evaluation."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from dual_system.tasks.environment import Snapshot
from dual_system.tasks.kitchen.control import CONTROL_HZ
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS, twin_of
from dual_system.tasks.task import TaskError


class Retold(KitchenEnvironment):
    """Begins in the seed's own start, and shows and judges the twin of the goal that the seed draws."""

    def reset(self, seed: int, difficulty: str | None = None, *, goal: int | None = None) -> Snapshot:
        """As everywhere; and raises TaskError for a task, which has one goal."""
        if self.name not in GOAL_SETS:
            raise TaskError(f"{self.name} has one goal, so nothing can be retold; goal sets are {', '.join(GOAL_SETS)}")
        return super().reset(seed, difficulty, goal=twin_of(self.name, seed) if goal is None else goal)


class WithoutCue(KitchenEnvironment):
    """Shows no demonstration."""

    has_demonstration = False


class LastFrame(KitchenEnvironment):
    """Shows the last frame of the demonstration alone: the goal that is reached, and not how."""

    def demonstration(self, rate_hz: int = CONTROL_HZ, *, look_hz: int | None = None) -> Iterator[Snapshot]:
        yield from deque(super().demonstration(rate_hz, look_hz=look_hz), maxlen=1)


KINDS: dict[str, type[KitchenEnvironment]] = {
    "own": KitchenEnvironment,
    "retold": Retold,
    "without-cue": WithoutCue,
    "last-frame": LastFrame,
}
"""By what ``pp-eval --pictures`` names."""
