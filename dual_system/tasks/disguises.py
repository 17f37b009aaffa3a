"""Environments that show their pictures otherwise, to ask what a policy reads from them: controls of an evaluation.

Physics and instruction are the episode's own, and so is the judgement, unless the past is retold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

from numpy.typing import ArrayLike

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import IMAGE_PX, MAX_STEPS, Environment, Snapshot
from dual_system.tasks.physics import CONTROL_HZ
from dual_system.tasks.task import TaskError, make_task

Pictures = Literal["own", "other-scene", "without-cue", "retold"]

_NEVER = 10**9


def disguised(name: str, pictures: Pictures, *, render: bool = True, max_steps: int = MAX_STEPS) -> Environment:
    """Returns an environment of a task that shows the given pictures. Raises TaskError for an unknown name."""
    kinds = {"own": Environment, "other-scene": OtherScene, "without-cue": WithoutCue, "retold": Retold}
    return kinds[pictures](make_task(name), image_px=IMAGE_PX, render=render, max_steps=max_steps)


class OtherScene(Environment):
    """Shows another scene of the task, in which the arm does what it is commanded here.

    That scene is of the demo split, whatever the episode's. It is shown as it is at its end once it is over.
    """

    def __init__(self, task: Any, *, image_px: int, render: bool, max_steps: int) -> None:
        super().__init__(task, image_px=image_px, render=False, max_steps=max_steps)
        self._other = Environment(task, image_px=image_px, render=render, max_steps=_NEVER)
        self._seen_last: Snapshot | None = None

    def reset(self, seed: int, difficulty: str | None = None, *, layout: Any = None) -> Snapshot:
        difficulty = DIFFICULTIES[seed % 3] if difficulty is None else difficulty
        self._seen_last = self._other.reset(another_seed(seed), difficulty)
        return self._with_its_pictures(super().reset(seed, difficulty, layout=layout))

    def step(self, action: ArrayLike, *, look: bool = True) -> Snapshot:
        snapshot = super().step(action, look=False)
        assert self._seen_last is not None
        if self._seen_last.status is Status.ONGOING:
            self._seen_last = self._other.step(action)
        return self._with_its_pictures(snapshot) if look else snapshot

    def demonstration(self, rate_hz: int = CONTROL_HZ, *, look_hz: int | None = None) -> Iterator[Snapshot]:
        return self._other.demonstration(rate_hz, look_hz=look_hz)

    def close(self) -> None:
        self._other.close()
        super().close()

    def _with_its_pictures(self, snapshot: Snapshot) -> Snapshot:
        assert self._seen_last is not None
        return replace(snapshot, frames=self._seen_last.frames)


class WithoutCue(Environment):
    """Never shows what only memory could tell later (`Task.cues`)."""

    def _begin(self, difficulty: str, layout: Any) -> None:
        super()._begin(difficulty, layout)
        for body in self.task.cues(layout):
            self.physics.hide(body)


class Retold(Environment):
    """Shows the scene after another past, which decides what is right (`Task.retold`). A layout is taken as it is."""

    def reset(self, seed: int, difficulty: str | None = None, *, layout: Any = None) -> Snapshot:
        """As everywhere; and raises TaskError for a task whose past cannot be retold."""
        if layout is None:
            super().reset(seed, difficulty)
            layout = next(iter(self.task.retold(self.layout)), None)
        if layout is None:
            raise TaskError(f"{self.task.name} has one past only in the scene of seed {seed}; leave this task out")
        return super().reset(seed, difficulty, layout=layout)


def another_seed(seed: int) -> int:
    """Returns a seed of the demo split that is not the given one."""
    return (seed + 50_000) % 100_000
