"""``pp-collect kitchen``: pairs of the kitchen's tasks and goal sets, a GR-1's demonstration and a Panda's execution.

The same jobs, folders and guarantees as ``pp-collect``. The script is rehearsed for the demonstration; a seed whose
script misses its goal is rejected and counted, and the next one tried. Both begin in one state, to the bit.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.collect import (
    DONE,
    INCOMPLETE,
    INTERRUPTED,
    MachineOptions,
    collect,
    print_line,
    workers_on,
)
from dual_system.data.dataset import Dataset
from dual_system.data.episode import About, Package, Rejection, RobotColumns
from dual_system.data.errors import DatasetError
from dual_system.data.jobs import ATTEMPTS
from dual_system.data.paired import PANDA_OMRON, Instant, pack_pair, write_splits
from dual_system.data.rollout import UNSOLVED
from dual_system.data.video import FPS, check_image_px
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.environment import IMAGE_PX, KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.scene import SceneFullError
from dual_system.tasks.seeds import FIRST_COLLECTION_SEED
from dual_system.tasks.task import TaskError
from protocol.command_line import command, parse
from protocol.version import DISTRIBUTION

Rate = Literal[1, 2, 4, 5, 10, 20]


@dataclass(frozen=True, slots=True, kw_only=True)
class PairJob:
    """One pair to collect."""

    task: str  # or a goal set
    slot: int
    image_px: int
    demonstration_hz: int
    invocation_hz: int

    @property
    def key(self) -> str:
        """A unique name under which the pair is stored; keys sort as jobs do."""
        return f"{self.task}/{self.slot:06d}"

    def seed(self, attempt: int) -> int:
        """The scene's seed of an attempt; no two jobs of a task share one."""
        return FIRST_COLLECTION_SEED + ATTEMPTS * self.slot + attempt


@dataclass(frozen=True, slots=True, kw_only=True)
class KitchenOptions:
    """Collects pairs of the kitchen into a LeRobot v3 dataset. The same command again resumes a killed run."""

    out: Path
    """Folder of the dataset."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """Names of tasks or of goal sets. Empty: the twenty-four tasks."""
    episodes: int = 100
    """Number of pairs per task (RoboCasa-DC: 100)."""
    demonstration_hz: Rate = 1
    """Rate of a demonstration's pictures in Hz; its last frame is always rendered."""
    invocation_hz: Rate = 20
    """Rate of an execution's pictures in Hz; rows between repeat them."""
    image_px: int = IMAGE_PX
    """Side of the pictures in pixels, an even number (benchmark: 128)."""
    machine: tyro.conf.OmitArgPrefixes[MachineOptions] = field(default_factory=MachineOptions)

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.machine.workers < 1:
            raise DatasetError("--episodes and --workers must be at least 1")
        check_image_px(self.image_px)

    @property
    def robot(self) -> RobotColumns:
        return PANDA_OMRON

    def task_names(self) -> tuple[str, ...]:
        """The tasks, each once. Raises TaskError for an unknown one."""
        if unknown := [name for name in self.tasks if name not in TASKS and name not in GOAL_SETS]:
            raise TaskError(f"unknown kitchen task {unknown[0]!r}; expected {', '.join([*TASKS, *GOAL_SETS])}")
        return tuple(dict.fromkeys(self.tasks)) or tuple(TASKS)

    def jobs(self) -> list[PairJob]:
        return [
            PairJob(
                task=task,
                slot=slot,
                image_px=self.image_px,
                demonstration_hz=self.demonstration_hz,
                invocation_hz=self.invocation_hz,
            )
            for task in self.task_names()
            for slot in range(self.episodes)
        ]

    def settings(self) -> dict[str, Any]:
        return {
            "first_seed": FIRST_COLLECTION_SEED,
            "image_px": self.image_px,
            "look": {"demonstration_hz": self.demonstration_hz, "execution_hz": self.invocation_hz},
            "versions": {name: metadata.version(name) for name in (DISTRIBUTION, "mujoco", "numpy", "av", "pyarrow")},
        }


@command("pp-collect kitchen")
def main(argv: list[str] | None = None, prog: str = "pp-collect kitchen") -> int:
    options = parse(KitchenOptions, argv, prog=prog)
    try:
        report = collect(options, workers_on(options.machine, work_out), say=print_line)
    except KeyboardInterrupt:
        sys.stderr.write(f"{prog}: interrupted; finished pairs are kept, the same command goes on\n")
        return INTERRUPTED
    write_splits(options.out, [entry.task for entry in Dataset(options.out).episodes])
    print_line(f"{report.num_episodes} pairs in {options.out} ({report.num_rejected} seeds rejected)")
    for key in report.unsolved:
        sys.stderr.write(f"{prog}: no pair for {key}: the script solved none of its seeds\n")
    return INCOMPLETE if report.unsolved else DONE


def work_out(job: PairJob) -> Package:
    """Tries the job's seeds in turn; returns the first pair, or the rejections if there is none."""
    rejected: list[Rejection] = []
    with KitchenEnvironment(job.task, image_px=job.image_px) as environment:
        for attempt in range(ATTEMPTS):
            seed = job.seed(attempt)
            try:
                return record(environment, job, seed, tuple(rejected))
            except (UnreachableError, SceneFullError) as error:
                rejected.append(Rejection(seed=seed, reason=str(error)))
    return {UNSOLVED: (json.dumps([asdict(each) for each in rejected]) + "\n").encode()}


def record(environment: KitchenEnvironment, job: PairJob, seed: int, rejected: tuple[Rejection, ...] = ()) -> Package:
    """One attempt. Raises UnreachableError where the script misses its goal, or what the scene raises."""
    environment.reset(seed)
    shown = [
        next(iter(snapshot.frames.values()), None)
        for snapshot in environment.demonstration(look_hz=job.demonstration_hz)
    ]
    about = About(
        task=job.task,
        instruction=environment.instruction,
        seed=seed,
        difficulty="",
        origin="script",
        is_success=True,
        image_px=job.image_px,
        rejected=rejected,
    )
    execution = _executed(environment, FPS // job.invocation_hz)
    return pack_pair(shown, execution, about, words=environment.scene.instruction)


def _executed(environment: KitchenEnvironment, look_every: int) -> Iterator[Instant]:
    """Yields what is seen before each action of the rehearsal, and the action: it was simulated once already."""
    start = environment.save()
    for step, moment in enumerate(environment.rehearse()):
        if moment.action is not None:
            now = replace(start, step=step, world=moment.world)
            snapshot = environment.restore(now, look=step % look_every == 0)
            yield Instant(state=snapshot.state, action=moment.action.astype(np.float32), frames=snapshot.frames)


if __name__ == "__main__":
    sys.exit(main())
