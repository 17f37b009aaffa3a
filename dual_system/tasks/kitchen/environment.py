"""The order of calls for a kitchen task: draw and build a scene, act for 50 ms, judge, render. As `tasks.environment`.

A scene is generated per seed, so that every reset compiles a model; the robot is a PandaOmron with three views. Seeds
of held-out scenes show held-out instances of the objects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Snapshot, steps_between
from dual_system.tasks.geometry import Array, pose_of
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen import predicates, puppet
from dual_system.tasks.kitchen.catalogue import PAPER_HORIZON, TASKS, draw_scene
from dual_system.tasks.kitchen.control import CONTROL_HZ
from dual_system.tasks.kitchen.goals import GOAL_SETS, SHOWN_ALONE, draw_goal_scene, drawn_goal
from dual_system.tasks.kitchen.layout import NUM_ACTION
from dual_system.tasks.kitchen.omron import VIEWS
from dual_system.tasks.kitchen.performing import perform
from dual_system.tasks.kitchen.plan import Instances, Scene
from dual_system.tasks.kitchen.scripts import script
from dual_system.tasks.kitchen.steps import here
from dual_system.tasks.kitchen.world import World, WorldState
from dual_system.tasks.rendering import Cameras
from dual_system.tasks.seeds import UNTRAINED, split_of
from dual_system.tasks.task import TaskError

IMAGE_PX = 128
_WAITING = np.zeros(NUM_ACTION)
_WAITING[-1] = -1.0
_REST_STEPS = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeState:
    """A saved episode: restoring it, in any environment, continues it exactly."""

    scene: Scene
    step: int
    world: WorldState
    memory: predicates.Memory
    status: Status
    reason: str
    action: Array  # (12,) the last one


class KitchenEnvironment:
    """One kitchen task or goal set, stepped at 20 Hz. Use it as a context manager or close it.

    Args:
        name: of one of the twenty-four tasks, or of a goal set.
        image_px: side of the pictures.
        render: without it, snapshots have no pictures and no GL is needed.
        max_steps: after which an episode ends; the paper's 1000 for every task.

    Raises:
        TaskError: there is no such task.
    """

    def __init__(
        self, name: str, *, image_px: int = IMAGE_PX, render: bool = True, max_steps: int = PAPER_HORIZON
    ) -> None:
        if name not in TASKS and name not in GOAL_SETS:
            raise TaskError(f"unknown kitchen task {name!r}; expected one of {', '.join([*TASKS, *GOAL_SETS])}")
        self.name = name
        self._image_px = image_px if render else None
        self._max_steps = max_steps
        self._world: World | None = None
        self._cameras: Cameras | None = None
        self._memory = predicates.Memory()
        self._step, self._status, self._reason = 0, Status.ONGOING, ""
        self._action: Array = _WAITING
        self._start: WorldState | None = None
        self._rehearsal: tuple[puppet.Moment, ...] | None = None

    @property
    def scene(self) -> Scene:
        """Bay and goals of this episode."""
        return self.world.scene

    @property
    def world(self) -> World:
        """The simulated scene. Raises RuntimeError before the first reset."""
        if self._world is None:
            raise RuntimeError("no episode has begun; call reset first")
        return self._world

    @property
    def instruction(self) -> str:
        """The instruction of this episode; that of a goal set does not tell the goal."""
        return SHOWN_ALONE if self.name in GOAL_SETS else self.scene.instruction

    @property
    def layout(self) -> Scene:
        """Scene and goal of this episode, by the name that the sixteen's environment has for it."""
        return self.scene

    def reset(self, seed: int, difficulty: str | None = None, *, goal: int | None = None) -> Snapshot:
        """Begins the episode of a seed and returns its first snapshot.

        With a goal set, ``goal`` asks for another of its goals from the very same start. Raises ValueError for a task,
        which has one goal, and TaskError for a difficulty: a kitchen has none.
        """
        if difficulty is not None:
            raise TaskError(f"{self.name} has no difficulties, so {difficulty!r} cannot be chosen; leave it out")
        instances = instances_of(seed)
        if self.name in GOAL_SETS:
            scene = draw_goal_scene(self.name, seed, goal, instances)
        elif goal is None:
            scene = draw_scene(self.name, seed, instances)
        else:
            raise ValueError(f"{self.name} has one goal; goal={goal} is for a goal set: {', '.join(GOAL_SETS)}")
        self._begin(scene)
        self._start = self.world.save()
        return self._observe()

    def step(self, action: ArrayLike, *, look: bool = True) -> Snapshot:
        """Applies an action (12,) for exactly 50 ms and returns the snapshot after it; without ``look``, no pictures.

        Numbers beyond [-1, 1] are clipped. Raises ValueError if it has another shape or is not finite, and RuntimeError
        if the episode is over or never began.
        """
        world = self.world
        if self._status is not Status.ONGOING:
            raise RuntimeError(
                f"the episode ended with {self._status.value} at step {self._step} ({self._reason}); "
                "call reset before stepping on"
            )
        self._action = _checked(action)
        world.advance(self._action)
        self._step += 1
        return self._observe(look=look)

    def oracle(self) -> Iterator[NDArray[np.float32]]:
        """Yields the actions (12,) of the script, each computed from the state in which it is requested.

        It ends early where the arm cannot do the next thing, and else a while after the last one.
        """
        try:
            yield from _script(self.world)
        except UnreachableError:
            return

    has_demonstration: ClassVar[bool] = True
    difficulty: ClassVar[str] = ""

    def demonstration(self, rate_hz: int = CONTROL_HZ, *, look_hz: int | None = None) -> Iterator[Snapshot]:
        """Yields GR-1's demonstration from this episode's start at ``rate_hz``, its pictures of one camera.

        With ``look_hz`` only snapshots at that rate have pictures, and the last one. The episode does not change.
        Raises ValueError unless the rates divide 20 Hz, and UnreachableError as `rehearse` does.
        """
        every, look_every = (steps_between(rate) for rate in (rate_hz, look_hz or rate_hz))
        scene, moments = self.scene, self.rehearse()
        body = puppet.Puppet(scene, TASKS[scene.goals[scene.goal].task].family)
        poses = body.poses(moments)
        shown = range(0, len(poses), every)
        looked_at = {*(step for step in shown if step % look_every == 0), *shown[-1:]}
        cameras = self._open(body, (puppet.CAMERA,))
        try:
            for step in shown:
                body.pose(poses[step])
                frames = cameras.frames() if cameras is not None and step in looked_at else {}
                yield replace(
                    self._snapshot(look=False), step=step, frames=frames, status=Status.ONGOING, reason="",
                    is_demonstration=True,
                )  # fmt: skip
        finally:
            if cameras is not None:
                cameras.close()

    def rehearse(self) -> tuple[puppet.Moment, ...]:
        """Returns what the script does from this episode's start until it reaches the goal; it is played once.

        A scene has a demonstration if and only if the script solves it. Raises UnreachableError if it does not. The
        episode does not change.
        """
        if self._rehearsal is None:
            assert self._start is not None
            now = self.world.save()
            self.world.load(self._start)
            try:
                self._rehearsal = tuple(puppet.record(self.world, _until_done(self.world)))
            finally:
                self.world.load(now)
        return self._rehearsal

    @property
    def own_goal(self) -> int:
        """The goal that the seed draws, whichever is asked for."""
        return drawn_goal(self.name, self.scene.seed) if self.name in GOAL_SETS else 0

    @property
    def goal_done(self) -> int | None:
        """The goal that has ended the episode; None if none has."""
        if self._status not in (Status.SUCCESS, Status.FAIL):
            return None
        return predicates.fired(self.world.view, self._memory, self.scene.goals)

    def save(self) -> EpisodeState:
        """Returns a copy of the current state of the whole episode."""
        return EpisodeState(
            scene=self.scene,
            step=self._step,
            world=self.world.save(),
            memory=self._memory,
            status=self._status,
            reason=self._reason,
            action=self._action,
        )

    def restore(self, state: EpisodeState, *, look: bool = True) -> Snapshot:
        """Continues a saved episode and returns its snapshot. Raises TaskError if it is another task's."""
        if state.scene.task != self.name:
            raise TaskError(f"the saved episode is of {state.scene.task!r}; this environment runs {self.name!r}")
        if self._world is None or self._world.scene != state.scene:
            self._begin(state.scene)
            self._start = self.world.save()
        self.world.load(state.world)
        self._step, self._memory, self._action = state.step, state.memory, state.action
        self._status, self._reason = state.status, state.reason
        return self._snapshot(look=look)

    def close(self) -> None:
        """Frees the renderer. May be called twice."""
        if self._cameras is not None:
            self._cameras.close()
            self._cameras = None

    def __enter__(self) -> KitchenEnvironment:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self, scene: Scene) -> None:
        self.close()
        self._world, self._rehearsal = World(scene), None
        self._cameras = self._open(self._world, VIEWS)
        self._memory = predicates.remember(self._world.view, None)
        self._step, self._status, self._reason, self._action = 0, Status.ONGOING, "", _WAITING

    def _open(self, world: World | puppet.Puppet, cameras: Sequence[str]) -> Cameras | None:
        if self._image_px is None:
            return None
        size = world.model.vis.global_
        size.offwidth = size.offheight = self._image_px  # MuJoCo clears all of its buffer for every picture
        return Cameras(world, self._image_px, cameras)

    def _observe(self, *, look: bool = True) -> Snapshot:
        world, scene = self.world, self.scene
        if self._step:
            self._memory = predicates.remember(world.view, self._memory)
        done = predicates.fired(world.view, self._memory, scene.goals)
        if done == scene.goal:
            self._status, self._reason = Status.SUCCESS, "goal reached"
        elif done is not None:
            self._status, self._reason = Status.FAIL, f"another goal was reached: {scene.goals[done].instruction}"
        elif self._step >= self._max_steps:
            self._status, self._reason = Status.TIMEOUT, f"not done after {self._max_steps} steps"
        return self._snapshot(look=look)

    def _snapshot(self, *, look: bool) -> Snapshot:
        world = self.world
        is_decided = self._status in (Status.SUCCESS, Status.FAIL) and len(self.scene.goals) > 1
        return Snapshot(
            step=self._step,
            frames=self._cameras.frames() if look and self._cameras is not None else {},
            state=world.state().astype(np.float32),
            command=self._action.astype(np.float32),
            tcp_pose=pose_of(here(world.view)),
            status=self._status,
            reason=self._reason,
            simple_subgoal=self.scene.instruction,
            grounded_subgoal=self.scene.instruction,
            subtask_index=int(self._status is Status.SUCCESS),
            subgoal_index=0,
            first_choice=self._status is Status.SUCCESS if is_decided else None,
        )


def instances_of(seed: int) -> Instances:
    """Returns the split of objects that a seed's scene shows: B, held out, in scenes that nothing trains on."""
    return "B" if split_of(seed) in UNTRAINED else "A"


def _script(world: World) -> Iterator[NDArray[np.float32]]:
    """Yields the script's actions, then waits: what was let go may still have to come to rest."""
    scene = world.scene
    for action in perform(world, script(scene.goals[scene.goal], world.view)):
        yield action.astype(np.float32)
    for _ in range(_REST_STEPS):
        yield _WAITING.astype(np.float32)


def _until_done(world: World) -> Iterator[Array]:
    """Yields the script's actions up to the goal, as an episode takes them. Raises UnreachableError if it is missed."""
    scene = world.scene
    memory = predicates.remember(world.view, None)
    for action, _ in zip(_script(world), range(PAPER_HORIZON), strict=False):
        yield _checked(action)
        memory = predicates.remember(world.view, memory)
        done = predicates.fired(world.view, memory, scene.goals)
        if done == scene.goal:
            return
        if done is not None:
            break
    raise UnreachableError(f"{scene.task}, seed {scene.seed}: the script misses its goal; there is no demonstration")


def _checked(action: ArrayLike) -> Array:
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (NUM_ACTION,):
        raise ValueError(f"action has shape {values.shape}; expected ({NUM_ACTION},), see kitchen.layout.ACTION_PARTS")
    if not np.isfinite(values).all():
        raise ValueError(f"action {values.tolist()} is not finite")
    return np.clip(values, -1.0, 1.0)
