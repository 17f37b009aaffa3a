"""A worker's job: the oracle plays an episode, which is then packed."""

from __future__ import annotations

import atexit
import functools
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.dart import Dart, episode_std_rad
from dual_system.data.episode import About, EpisodeWriter, Package, Rejection, Row
from dual_system.data.jobs import ATTEMPTS, Job, Look, failed_grasp
from dual_system.data.shove import Shoves, is_shoved
from dual_system.data.video import FPS, Frame
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.geometry import pose_of
from dual_system.tasks.kinematics import Kinematics, UnreachableError
from dual_system.tasks.oracle import FailedGrasp, Motions
from dual_system.tasks.scene import SceneFullError

UNSOLVED = "unsolved.json"
"""The only file of a package whose job found no seed that the oracle solves: the list of rejected seeds."""
Action = NDArray[np.float32]
Take = Callable[[Row, dict[str, Frame]], None]


class UnsolvedError(Exception):
    """The oracle did not solve this episode; the message gives the reason."""


class Narrator:
    """Turns an environment's snapshots into rows."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._kinematics = Kinematics(environment.physics.model)

    def tcp_pose(self, state: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the tool's pose (7,) at the joints of a state (8,)."""
        return pose_of(self._kinematics.tcp(state[:7].astype(np.float64))).astype(np.float32)

    def demonstration(self, look_hz: int) -> Iterator[tuple[Row, dict[str, Frame]]]:
        """Yields the rows of the conditioning video, with pictures at ``look_hz``."""
        for snapshot in self._environment.demonstration(FPS, look_hz=look_hz):
            yield replace(self.row(snapshot, snapshot.command), is_demonstration=True), dict(snapshot.frames)

    def reasoning(self) -> str:
        """Returns the demonstration reasoning, empty without a demonstration; call it when that has just ended."""
        return self._environment.reasoning() if self._environment.has_demonstration else ""

    def row(self, snapshot: Snapshot, action: Action) -> Row:
        """Returns the row of a snapshot and the action that follows it."""
        return Row(
            state=snapshot.state,
            action=np.asarray(action, np.float32),
            tcp_pose=self.tcp_pose(snapshot.state),
            subgoal=snapshot.simple_subgoal,
            grounded_subgoal=snapshot.grounded_subgoal,
        )


class Scribe:
    """Steps an environment and passes every row to ``take`` (as `EpisodeWriter.add`) before its action is executed.

    If ``take`` is None, nothing is rendered.
    """

    def __init__(self, environment: Environment, take: Take | None, look: Look) -> None:
        self._environment, self._take, self._look = environment, take, look
        self._narrator = Narrator(environment)
        self._subgoal_index, self._reasoning = -1, ""

    def begin(self) -> None:
        """Passes on the rows of the conditioning video, if there is one; call it right after a reset."""
        if self._take is None:
            return
        for row, frames in self._narrator.demonstration(self._look.demonstration_hz):
            self._take(row, frames)
        self._reasoning = self._narrator.reasoning()

    def step(self, snapshot: Snapshot, action: Action, executed: Action | None = None) -> Snapshot:
        """Executes ``executed``, or the action itself; the row holds the action."""
        done = action if executed is None else executed
        if self._take is None:
            return self._environment.step(done, look=False)
        row = replace(
            self._narrator.row(snapshot, action),
            is_transition=snapshot.subgoal_index != self._subgoal_index,
            demonstration_reasoning=self._reasoning,
            executed_action=executed,
        )
        self._take(row, dict(snapshot.frames))
        self._subgoal_index, self._reasoning = snapshot.subgoal_index, ""
        looks = (snapshot.step + 1) % (FPS // self._look.execution_hz) == 0
        return self._environment.step(done, look=looks)


def work_out(job: Job) -> Package:
    """Tries the job's seeds in turn; returns the first solved episode, or the rejections if there is none."""
    environment = kept_environment(job.task, job.image_px, job.max_steps, texts_follow=job.texts_follow)
    rejected: list[Rejection] = []
    for attempt in range(ATTEMPTS):
        seed = job.seed(attempt)
        try:
            return _solve(environment, job, seed, tuple(rejected))
        except (UnsolvedError, UnreachableError, SceneFullError) as error:
            noise_rad = episode_std_rad(job.noise, seed)
            rejected.append(Rejection(seed=seed, reason=str(error), noise_rad=noise_rad))
    return {UNSOLVED: (json.dumps([asdict(each) for each in rejected]) + "\n").encode()}


def _solve(environment: Environment, job: Job, seed: int, rejected: tuple[Rejection, ...]) -> Package:
    """One attempt. Raises UnsolvedError, or what the scene or the oracle raises."""
    fails: FailedGrasp | None = None
    if job.recovery != "none":  # a rehearsal without pictures counts the grasps that could fail
        fails = failed_grasp(job.recovery, seed, play(environment, job, seed).num_grasps)
    writer = EpisodeWriter(job.image_px)
    play(environment, job, seed, fails, writer.add)
    return writer.pack(
        About(
            task=job.task,
            instruction=environment.instruction,
            seed=seed,
            difficulty=job.difficulty,
            origin="oracle",
            is_success=True,
            image_px=job.image_px,
            recovery=job.recovery if fails else "none",
            rejected=rejected,
            noise_rad=episode_std_rad(job.noise, seed),
        )
    )


def play(
    environment: Environment, job: Job, seed: int, fails: FailedGrasp | None = None, take: Take | None = None
) -> Motions:
    """Plays an episode with the oracle, under the job's noise and shoves, and hands its rows to ``take``.

    Without ``take`` nothing is rendered. Returns the motions made. Raises UnsolvedError unless it ends with success.
    """
    snapshot = environment.reset(seed, job.difficulty)
    scribe = Scribe(environment, take, job.look)
    scribe.begin()
    shoves = Shoves(environment.physics, environment.subtasks, seed) if is_shoved(seed, job.shove_share) else None
    motions = Motions(environment.physics, fails, watches=shoves is not None)
    script = environment.oracle(motions)
    dart = Dart(environment.physics, seed) if job.noise == "dart" else None
    while snapshot.status is Status.ONGOING:
        if shoves is not None:
            shoves.step(snapshot.subtask_index)
        action = asked(script, snapshot)
        snapshot = scribe.step(snapshot, action, None if dart is None else dart.executed(action))
    check_solved(snapshot)
    return motions


def asked(script: Iterator[Action], snapshot: Snapshot) -> Action:
    """Returns the script's next action. Raises UnsolvedError if it has none."""
    action = next(script, None)
    if action is None:
        raise UnsolvedError(f"the script ended after {snapshot.step} steps and the episode did not")
    return action


def check_solved(snapshot: Snapshot) -> None:
    """Raises UnsolvedError unless the episode ended with success."""
    if snapshot.status is not Status.SUCCESS:
        raise UnsolvedError(f"{snapshot.status.value} after {snapshot.step} steps: {snapshot.reason}")


@functools.lru_cache(maxsize=1)  # building a scene takes seconds, and jobs come task by task
def kept_environment(task: str, image_px: int, max_steps: int, *, texts_follow: bool = False) -> Environment:
    """Returns this process's environment, kept until another one is needed or the process ends."""
    environment = make_environment(task, image_px=image_px, max_steps=max_steps, texts_follow=texts_follow)
    environment.open_cameras()
    atexit.unregister(kept_environment.cache_clear)
    atexit.register(
        kept_environment.cache_clear
    )  # after MuJoCo has registered its own: the last one in is the first to run
    return environment
