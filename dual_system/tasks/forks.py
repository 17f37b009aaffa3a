"""Two episodes that look the same now and had different pasts: only memory can tell them apart.

Both branches of a fork continue from one state: joints, speeds, objects and motors are the same bits in both, and so is
every frame. The other past is made in one of three ways, by the task:

*Retold*: the same actions, played from reset under another layout of `Task.retold`. Only what was shown differs:
another cube was lit, other colours were covered. Nothing is cut and nothing jumps.

*Another video*: retold too, where only the conditioning video differs. Another motion leaves the arm and the objects
slightly elsewhere, so after its own video the twin starts from the episode's first state, its clock included; from
there on the actions are the same. No frame shows the step from the video's last frame to the first observation, and
`Fork.seam` is how far things jump there.

*Cut*: where the past repeats itself, as in counting, there is an earlier moment that looked like now, and everything
since is taken out of the twin's past: it had one round less. The twin keeps the memory, the texts and the clock of that
moment and gets the state of now. The present is exact; `Fork.seam` is how far things jump between the twin's last
memory and now.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from dual_system.tasks import sight
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, EpisodeState
from dual_system.tasks.physics import Physics, PhysicsState
from dual_system.tasks.scene import CAMERAS

MAX_SEAM = 0.005  # rad or m; about half a pixel of the front camera

_ELSEWHERE = 0.1  # rad or m
_SIGHT_PX = 256
_LOOK_STEPS = 5  # what is shown at all is shown for longer

ItemT = TypeVar("ItemT")


class ForkError(RuntimeError):
    """The episode has no such twin at this moment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Branch:
    """One of two episodes that look the same now. Restoring a state shows it; stepping on from ``now`` continues it."""

    past: tuple[EpisodeState, ...]  # one per control step from the first observation on; the last is one before ``now``
    now: EpisodeState


@dataclass(frozen=True, slots=True, kw_only=True)
class Fork:
    """An episode and its twin."""

    own: Branch
    twin: Branch
    is_cut: bool  # else it is retold
    seam: float  # rad or m: jump of the objects on a cut twin's last step or after another video; 0 without either


def fork(environment: Environment, variant: int = 0) -> Fork:
    """Returns the episode that an environment is in, and a twin; the environment's state is restored.

    Variants count from 0: retold layouts in the task's order, cuts from the latest on. Raises ForkError if the episode
    is over, did not come here from its own reset, or has no such twin now.
    """
    task, now = environment.task, environment.save()
    if now.progress.status is not Status.ONGOING:
        raise ForkError(f"the episode ended at step {now.step}; fork it before it does")
    try:
        environment.reset(0, now.difficulty, layout=now.layout)
        own = _replayed(environment, now)
        if _is_another_world(environment.physics, own.now.physics, now.physics):
            raise ForkError("this episode did not come here from its own reset; fork the one that it was forked from")
        if not task.repeats_itself:
            layouts = task.retold(now.layout)
            seam = retell(environment, _nth(layouts, variant, now.step), (*own.past, own.now)[0])
            other = _replayed(environment, now)
            if _is_another_world(environment.physics, other.now.physics, now.physics):
                raise ForkError(f"at step {now.step} one still sees which past it was; step on until nothing is shown")
            if not _was_shown_apart(environment.physics, own, other):
                raise ForkError(f"by step {now.step} nothing has been shown yet that could tell two pasts apart")
            twin = replace(other, now=_in_the_world_of(now, other.now))
            return Fork(own=own, twin=twin, is_cut=False, seam=seam)
        moment, seam = _nth(earlier_moments_like(environment.physics, own.past, now), variant, now.step)
        twin = Branch(past=own.past[:moment], now=_in_the_world_of(now, own.past[moment]))
        return Fork(own=own, twin=twin, is_cut=True, seam=seam)
    finally:
        environment.restore(now, look=False)


def retell(environment: Environment, layout: Any, first: EpisodeState) -> float:
    """Starts an episode's retold twin, given the episode's first state; returns the seam in rad or m.

    Raises ForkError if its video leaves objects too far from where the episode's video left them.
    """
    environment.reset(0, first.difficulty, layout=layout)
    if not environment.task.retells_video:
        return 0.0
    seam = environment.physics.gap(environment.save().physics, first.physics, scripted=False)
    if seam > MAX_SEAM:
        raise ForkError(
            f"the other video leaves things {seam:.3f} rad or m elsewhere; at most {MAX_SEAM} are passed over"
        )
    environment.begin_in(first.physics)
    return seam


def _is_another_world(physics: Physics, a: PhysicsState, b: PhysicsState) -> bool:
    """Returns whether two states differ visibly or in how they continue; hidden paint does not count.

    It casts rays and renders no pictures, and leaves the physics in one of the two states.
    """
    if a.integration.tobytes() != b.integration.tobytes():
        return True
    painted = physics.painted_apart(a, b)
    physics.load(b)
    return any(
        len(sight.visible_pixels(physics, camera, body, _SIGHT_PX)) > 0 for body in painted for camera in CAMERAS
    )


def _was_shown_apart(physics: Physics, a: Branch, b: Branch) -> bool:
    """Returns whether two pasts, conditioning videos included, differed visibly."""
    one, other = _shown(a), _shown(b)
    if len(one) != len(other):
        return True
    pairs = zip(one[::_LOOK_STEPS], other[::_LOOK_STEPS], strict=True)
    return any(_is_another_world(physics, *pair) for pair in pairs)


def _shown(branch: Branch) -> list[PhysicsState]:
    return [row.physics for row in branch.now.video] + [state.physics for state in branch.past]


def earlier_moments_like(
    physics: Physics, past: Sequence[EpisodeState], now: EpisodeState
) -> tuple[tuple[int, float], ...]:
    """Returns the moments that looked like ``now`` at other subtasks, latest first, each with its seam.

    The step before must look like the one before now, else bodies move differently; and in between they must have been
    elsewhere, else only waiting would be cut. Each subtask contributes its most similar moment.
    """
    gaps = [physics.gap(state.physics, now.physics) for state in past]
    best: dict[int, tuple[float, int]] = {}  # subtask -> its smallest gap, and when
    for step in range(1, len(past)):
        index, gap = past[step].progress.index, gaps[step]
        if index == now.progress.index or gap > MAX_SEAM or max(gaps[step:]) < _ELSEWHERE:
            continue
        if physics.gap(past[step - 1].physics, past[-1].physics) <= MAX_SEAM:
            best[index] = min(best.get(index, (gap, step)), (gap, step))
    return tuple((step, gap) for gap, step in sorted(best.values(), key=lambda found: -found[1]))


def _replayed(environment: Environment, now: EpisodeState) -> Branch:
    """Replays a state's actions in an episode that has just begun. Raises ForkError if it ends too early."""
    states = [environment.save()]
    for action in now.actions:
        if states[-1].progress.status is not Status.ONGOING:
            raise ForkError(f"the other past ends at step {states[-1].step}: {states[-1].progress.reason}")
        environment.step(action, look=False)
        states.append(environment.save())
    return Branch(past=tuple(states[:-1]), now=states[-1])


def _in_the_world_of(now: EpisodeState, twin: EpisodeState) -> EpisodeState:
    """Returns the twin in the state of now; its clock and its hidden paint are its own."""
    physics = replace(now.physics.at_the_time_of(twin.physics), geom_rgba=twin.physics.geom_rgba)
    return replace(twin, physics=physics)


def _nth(variants: Sequence[ItemT], variant: int, step: int) -> ItemT:
    if not 0 <= variant < len(variants):
        raise ForkError(f"no variant {variant} of this episode's past at step {step}; there are {len(variants)}")
    return variants[variant]
