"""Counterfactual pairs: moments at which two episodes look the same, and their scripts act differently.

A pair is found by playing. For a task that can be retold, both episodes are played with the same actions until their
scripts differ; then the robot waits until nothing shown tells them apart. For a task that repeats itself, the script is
played until a twin with one round less would act differently.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, EpisodeState, Snapshot
from dual_system.tasks.forks import Branch, Fork, ForkError, fork, retell
from dual_system.tasks.oracle import Motions
from dual_system.tasks.physics import CONTROL_HZ
from dual_system.tasks.task import make_task

PAST_HZ = 1  # PONDER's query rate
ORACLE_STEPS = 20  # one chunk

_PATIENCE_STEPS = 120
_PARTED = 0.02  # rad, or gripper command: actions that differ by less are the same act


@dataclass(frozen=True, slots=True, kw_only=True)
class Telling:
    """One branch: T frames of the past, the conditioning video first if there is one, and what the script does next."""

    frames: dict[str, NDArray[np.uint8]]  # camera name -> (T, image_px, image_px, 3)
    states: NDArray[np.float32]  # (T, 8)
    steps: NDArray[np.int64]  # (T,) control steps since reset; in a video, frames since it began
    is_demonstration: NDArray[np.bool_]  # (T,)
    oracle: NDArray[np.float32]  # (ORACLE_STEPS, 8): what the script does next
    subgoal: str  # grounded; this and the next are of the step after now, when they speak of what comes next
    reasoning: str  # see `Environment.reasoning`


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two tellings of one present."""

    task: str
    family: str
    seed: int
    difficulty: str
    variant: int
    is_cut: bool  # see `forks`
    seam: float  # rad or m; 0 unless cut, or after another video
    instruction: str
    frames: dict[str, NDArray[np.uint8]]  # now: camera name -> (image_px, image_px, 3); the same bytes in both
    state: NDArray[np.float32]  # (8,) now; likewise
    own: Telling
    twin: Telling


def find_pair(
    own: Environment,
    other: Environment,
    task: str,
    seed: int,
    variant: int | None = None,
    *,
    demo_hz: int = PAST_HZ,
    demo_to_its_end: bool = False,
) -> Pair | None:
    """Plays one episode until its twin would act differently; returns None if there is no such moment in it.

    Without a variant, those of `Task.retold` take turns by seed, and cuts are the latest. Frames of conditioning videos
    are taken at ``demo_hz`` and, with ``demo_to_its_end``, at the end.

    Both environments must be of the task; only the first needs cameras. Raises RuntimeError if the two branches do not
    look the same, which would be a defect.
    """
    kind = make_task(task)
    own.reset(seed)
    if kind.repeats_itself:
        variant = variant or 0
        found = _cut(own, variant)
    else:
        told = kind.retold(own.layout)
        if variant is None:
            variant = seed // len(DIFFICULTIES) % max(len(told), 1)  # the remainder decides the difficulty
        found = _retold(own, other, told[variant], variant) if variant < len(told) else None
    if found is None:
        return None
    now, twin_now = own.restore(found.own.now), own.restore(found.twin.now)
    if _bytes(now) != _bytes(twin_now):
        raise RuntimeError(f"{task}, seed {seed}, variant {variant}: the branches do not look the same at {now.step}")
    return Pair(
        task=task,
        family=kind.family,
        seed=seed,
        difficulty=found.own.now.difficulty,
        variant=variant,
        is_cut=found.is_cut,
        seam=found.seam,
        instruction=own.instruction,
        frames=dict(now.frames),
        state=now.state,
        own=_telling(own, found.own, demo_hz, demo_to_its_end),
        twin=_telling(own, found.twin, demo_hz, demo_to_its_end),
    )


def oracle_chunk(environment: Environment, state: EpisodeState, num_steps: int = ORACLE_STEPS) -> NDArray[np.float32]:
    """Returns what the script does next (num_steps, 8) in a saved episode; the last row stays if the episode ends."""
    environment.restore(state, look=False)
    rows: list[NDArray[np.float32]] = []
    for action in islice(environment.oracle(), num_steps):
        rows.append(action)
        if environment.step(action, look=False).status is not Status.ONGOING:
            break
    return np.stack(rows + rows[-1:] * (num_steps - len(rows)))


def _retold(own: Environment, other: Environment, layout: Any, variant: int) -> Fork | None:
    try:
        retell(other, layout, own.save())
    except ForkError:
        return None
    for action, others_action in zip(own.oracle(), other.oracle(), strict=False):
        if not np.array_equal(action, others_action):
            break
        if own.step(action, look=False).status is not Status.ONGOING:
            return None
        other.step(action, look=False)
    for _ in range(_PATIENCE_STEPS):
        try:
            found = fork(own, variant)
        except ForkError:
            if own.step(own.physics.command(), look=False).status is not Status.ONGOING:
                return None
            continue
        return found if _goes_apart(own, found) else None
    return None


def _cut(own: Environment, variant: int) -> Fork | None:
    motions = Motions(own.physics)
    for subtask in own.subtasks:
        for action in subtask.motion(motions):
            if own.step(action, look=False).status is not Status.ONGOING:
                return None
        try:
            found = fork(own, variant)
        except ForkError:
            continue
        if _goes_apart(own, found):
            return found
        own.restore(found.own.now, look=False)
    return None


def _goes_apart(environment: Environment, found: Fork) -> bool:
    own, twin = (oracle_chunk(environment, branch.now) for branch in (found.own, found.twin))
    return bool(np.abs(own - twin).max() > _PARTED)


def _telling(environment: Environment, branch: Branch, demo_hz: int, demo_to_its_end: bool) -> Telling:
    environment.restore(branch.now, look=False)
    seen = [*_video(environment, demo_hz, demo_to_its_end), *_past(environment, branch)]
    oracle = oracle_chunk(environment, branch.now)
    environment.restore(branch.now, look=False)
    next_ = environment.step(oracle[0], look=False)  # texts follow by one step
    cameras = tuple(seen[0].frames) if seen else ()
    return Telling(
        frames={camera: np.stack([snapshot.frames[camera] for snapshot in seen]) for camera in cameras},
        states=np.array([snapshot.state for snapshot in seen], dtype=np.float32).reshape(-1, 8),
        steps=np.array([snapshot.step for snapshot in seen], dtype=np.int64),
        is_demonstration=np.array([snapshot.is_demonstration for snapshot in seen], dtype=np.bool_),
        oracle=oracle,
        subgoal=next_.grounded_subgoal,
        reasoning=environment.reasoning(),
    )


def _video(environment: Environment, demo_hz: int, demo_to_its_end: bool) -> list[Snapshot]:
    if not demo_to_its_end:
        return [*environment.demonstration(demo_hz)]
    every = CONTROL_HZ // demo_hz
    video = [*environment.demonstration(look_hz=demo_hz)]  # in between there are no pictures
    return [*video[:-1][::every], *video[-1:]]


def _past(environment: Environment, branch: Branch) -> Iterator[Snapshot]:
    return (environment.restore(state) for state in branch.past[:: CONTROL_HZ // PAST_HZ])


def _bytes(snapshot: Snapshot) -> tuple[bytes, ...]:
    return (snapshot.state.tobytes(), *(frame.tobytes() for frame in snapshot.frames.values()))
