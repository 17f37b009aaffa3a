"""The jobs of a collection: one per kept episode, each with its own sequence of seeds.

Jobs are independent, so any number of workers in any order make the same set: a job tries its seeds in turn until the
oracle solves one. By default two of four episodes are easy, one is medium and one hard, as in RoboMME, and six of every
hundred have a failed grasp before the right one: three too high, three beside the object.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.dart import NoiseKind
from dual_system.data.episode import Recovery
from dual_system.data.video import FPS
from dual_system.tasks.difficulty import Difficulty
from dual_system.tasks.oracle import FailedGrasp
from dual_system.tasks.seeds import FIRST_COLLECTION_SEED

ATTEMPTS = 100
DIFFICULTY_CYCLE: tuple[Difficulty, ...] = ("easy", "easy", "medium", "hard")
RECOVERY_SHARE = 0.06  # upstream's
_RECOVERY_CYCLE = 100
_RECOVERY_STREAM = 1  # of a seed's random numbers; the scene draws from another
_ASIDE = tuple((x, y, 0) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Rates at which pictures are rendered; they divide 20 Hz, which is the rate of rows."""

    demonstration_hz: int = FPS
    execution_hz: int = FPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One episode to collect."""

    task: str
    slot: int  # which of the task's episodes, from 0
    image_px: int
    max_steps: int
    look: Look
    noise: NoiseKind = "none"
    recovery_share: float = RECOVERY_SHARE
    difficulties: tuple[Difficulty, ...] = DIFFICULTY_CYCLE
    texts_follow: bool = False
    shove_share: float = 0.0

    @property
    def key(self) -> str:
        """A unique name under which the episode is stored; keys sort as jobs do."""
        return f"{self.task}/{self.slot:06d}"

    @property
    def difficulty(self) -> str:
        return self.difficulties[self.slot % len(self.difficulties)]

    @property
    def recovery(self) -> Recovery:
        num_each = round(self.recovery_share * _RECOVERY_CYCLE / 2)
        place = self.slot % _RECOVERY_CYCLE
        return "z" if place < num_each else "xy" if place < 2 * num_each else "none"

    def seed(self, attempt: int) -> int:
        """Returns the scene's seed of an attempt from 0 to 99; no two jobs of a task share a seed."""
        return FIRST_COLLECTION_SEED + ATTEMPTS * self.slot + attempt


def jobs_of(
    tasks: Sequence[str],
    num_episodes: int,
    *,
    image_px: int,
    max_steps: int,
    look: Look,
    noise: NoiseKind = "none",
    recovery_share: float = RECOVERY_SHARE,
    difficulties: tuple[Difficulty, ...] = DIFFICULTY_CYCLE,
    texts_follow: bool = False,
    shove_share: float = 0.0,
    first_slot: int = 0,
) -> Iterator[Job]:
    """Yields the jobs task by task, in the order their episodes have in the dataset."""
    for task in tasks:
        for slot in range(first_slot, first_slot + num_episodes):
            yield Job(
                task=task,
                slot=slot,
                image_px=image_px,
                max_steps=max_steps,
                look=look,
                noise=noise,
                recovery_share=recovery_share,
                difficulties=difficulties,
                texts_follow=texts_follow,
                shove_share=shove_share,
            )


def failed_grasp(recovery: Recovery, seed: int, num_grasps: int) -> FailedGrasp | None:
    """Returns which of a script's grasps fails first and where it is aimed; None if none is to fail."""
    if recovery == "none" or num_grasps == 0:
        return None
    rng = np.random.default_rng((seed, _RECOVERY_STREAM))
    before = int(rng.integers(num_grasps))
    offset = (0, 0, 1) if recovery == "z" else _ASIDE[rng.integers(len(_ASIDE))]
    return FailedGrasp(before=before, offset=offset)
