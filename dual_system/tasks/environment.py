"""The order of calls: reset, act for 50 ms, judge, render. One environment runs one task, one episode at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.tasks import captions, demonstration, engine, panda, predicates, sight
from dual_system.tasks.captions import Caption
from dual_system.tasks.demonstration import Row
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Progress, Status
from dual_system.tasks.geometry import Array, pose_of
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.oracle import Motions
from dual_system.tasks.physics import CONTROL_HZ, Physics, PhysicsState
from dual_system.tasks.rendering import Cameras
from dual_system.tasks.scene import FRONT, table_scene
from dual_system.tasks.task import Subtask, Task, TaskError, make_task

IMAGE_PX = panda.IMAGE_PX
_MAX_DRAWS = 20
_PUSHED_M = 0.01  # texts that follow are corrected from this distance on
MAX_STEPS = 1300  # the paper's limit; upstream's own default is 10000


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """The observation of one instant, before the next action, with outcome and texts. It owns its arrays."""

    step: int  # control steps since reset returned; in a demonstration, frames since it began
    frames: Mapping[str, NDArray[np.uint8]]  # camera name -> (image_px, image_px, 3) RGB; empty if not rendered
    state: NDArray[np.float32]  # (8,): seven joints [rad], one finger's opening [m], 0 without fingers
    command: NDArray[np.float32]  # (8,): the action that led here: joint targets [rad], gripper in [-1, 1]
    tcp_pose: NDArray[np.float64]  # (7,): xyz [m], quaternion wxyz
    status: Status
    reason: str  # why the episode ended; empty while it is ongoing
    simple_subgoal: str
    grounded_subgoal: str
    subtask_index: int  # the engine's; the texts follow it one step later, as upstream delivers them
    subgoal_index: int  # the subtask that the texts describe; two in a row may have the same text
    is_demonstration: bool = False  # a frame of the conditioning video; outcome and subtask are then those of a start
    first_choice: bool | None = None  # whether the episode's first choice was right; None before it


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeState:
    """A saved episode: restoring it, in any environment of the same task, continues it bit-exactly."""

    task: str
    difficulty: str
    layout: Any
    step: int
    physics: PhysicsState
    memory: Any
    progress: Progress
    caption: Caption
    video: tuple[Row, ...]
    actions: tuple[Array, ...]  # (8,) each, all since reset


def make_environment(
    name: str,
    *,
    image_px: int = IMAGE_PX,
    render: bool = True,
    max_steps: int = MAX_STEPS,
    texts_follow: bool = False,
) -> Environment:
    """Returns an environment of a registered task. Raises TaskError for an unknown name.

    With ``texts_follow`` the texts follow the scene: a grounded subgoal's coordinates are corrected when its objects
    have been pushed elsewhere, an object that was dropped on its way is to be picked up again, and of several objects
    that all count the next subgoal names one that is left (`Task.subtasks_after`). Upstream's texts keep the
    coordinates at which the objects were first seen, and go on down the list.
    """
    return Environment(
        make_task(name), image_px=image_px, render=render, max_steps=max_steps, texts_follow=texts_follow
    )


class Environment:
    """One task in its simulated world, stepped at 20 Hz. Use it as a context manager or close it.

    Without rendering it needs no GL; texts and physics are the same either way. The class is long because it is one
    idea, the order of calls: judging, captions, sight and the demonstration's performance are modules of their own.
    """

    def __init__(
        self,
        task: Task[Any, Any],
        *,
        image_px: int,
        render: bool,
        max_steps: int,
        texts_follow: bool = False,
    ) -> None:
        self.task = task
        self._texts_follow = texts_follow
        self._grounded_at: Array = np.zeros((0, 3))  # where the grounded text's objects were when it was written
        spec = table_scene(task.robot)
        task.furnish(spec)
        self.physics = Physics(spec)
        self._image_px = image_px if render else None
        self._cameras: Cameras | None = None  # opened by reset: a process that has a GL context cannot be forked
        self._max_steps = max_steps
        self._layout: Any = None
        self._memory: Any = None
        self._subtasks: tuple[Subtask, ...] = ()
        self._progress = Progress()
        self._caption: Caption | None = None
        self._step = 0
        self._video: tuple[Row, ...] = ()
        self._actions: list[Array] = []
        self.difficulty = ""

    @property
    def instruction(self) -> str:
        """The instruction of this episode."""
        self._require_episode()
        return self.task.instruction(self._layout)

    @property
    def layout(self) -> Any:
        """Scene and goal of this episode; the type is the task's."""
        self._require_episode()
        return self._layout

    @property
    def subtasks(self) -> tuple[Subtask, ...]:
        """The ordered list of subtasks of this episode."""
        self._require_episode()
        return self._subtasks

    @property
    def has_demonstration(self) -> bool:
        """Whether this episode begins with a conditioning video."""
        self._require_episode()
        return bool(self._video)

    def reset(self, seed: int, difficulty: str | None = None, *, layout: Any = None) -> Snapshot:
        """Starts an episode and returns its first snapshot, after the demonstration if there is one.

        The seed alone decides the scene. Without a difficulty it is the seed's remainder by three: easy, medium,
        hard, as upstream. A scene in which the arm cannot perform the demonstration is drawn again, as upstream's are
        until its planner solves one; a ``layout`` replaces the drawn ones. Raises TaskError for an unknown difficulty,
        and UnreachableError if there is no such scene.
        """
        difficulty = DIFFICULTIES[seed % 3] if difficulty is None else difficulty
        if difficulty not in DIFFICULTIES:
            raise TaskError(f"unknown difficulty {difficulty!r}; expected one of {', '.join(DIFFICULTIES)}")
        rng, is_given = np.random.default_rng(seed), layout is not None
        for tries_left in reversed(range(_MAX_DRAWS)):
            layout = layout if is_given else self.task.sample(rng, difficulty)
            self._begin(difficulty, layout)
            try:
                self._video, last_action = demonstration.perform(self.task, layout, self.physics, self._look_for)
                break
            except UnreachableError:
                if is_given or tries_left == 0:
                    raise
        # Upstream's reset spends one control step too: the button's cap settles on its spring.
        at_rest = np.append(panda.HOME_QPOS, self.physics.robot.rest_command)
        self.physics.advance(at_rest if last_action is None else last_action)
        return self._observe()

    def begin_in(self, found: PhysicsState) -> Snapshot:
        """Replaces the state that the demonstration has left; returns the first snapshot.

        `forks` lets two videos lead to one present this way. Raises RuntimeError after the first step.
        """
        self._require_episode()
        if self._step:
            raise RuntimeError(f"the episode is at step {self._step}; another world can only be found at step 0")
        self.physics.load(found)
        self._memory, self._caption, self._progress = None, None, Progress()
        return self._observe(look=False)

    def demonstration(self, rate_hz: int = CONTROL_HZ, *, look_hz: int | None = None) -> Iterator[Snapshot]:
        """Yields the conditioning video of this episode at ``rate_hz``, from its first frame on; nothing without one.

        It can be read at any time and any number of times: pictures are rendered on demand, and the episode does not
        change. With ``look_hz`` only snapshots at that rate have pictures, and the last one, because a movement often
        ends between two of them. Raises ValueError unless the rates divide 20 Hz.
        """
        self._require_episode()
        every, look_every = steps_between(rate_hz), steps_between(look_hz or rate_hz)
        shown = range(0, len(self._video), every)
        looked_at = {*(step for step in shown if step % look_every == 0), *shown[-1:]}
        return (self._demonstrated(step, self._video[step], look=step in looked_at) for step in shown)

    def step(self, action: ArrayLike, *, look: bool = True) -> Snapshot:
        """Applies an action (8,) for exactly 50 ms and returns the snapshot after it; without ``look``, no pictures.

        The action is seven absolute joint targets in rad and the gripper's command in [-1, 1], clipped there. Raises
        ValueError if it has another shape or is not finite, and RuntimeError if the episode is over or never began.
        """
        self._require_episode()
        if self._progress.status is not Status.ONGOING:
            raise RuntimeError(
                f"the episode ended with {self._progress.status.value} at step {self._step} "
                f"({self._progress.reason}); call reset before stepping on"
            )
        self._actions.append(_checked(action))
        self.physics.advance(self._actions[-1])
        self._step += 1
        return self._observe(look=look)

    def reasoning(self) -> str:
        """Returns what the current subtask needs from the past, as text (paper, Table 6); empty if nothing.

        Its coordinates are where objects are seen now, or were last seen in the video if they are hidden now and have
        not moved since; it ends with the grounded subgoal.
        """
        self._require_episode()
        assert self._caption is not None
        needed = self.task.reasoning(self._layout, self._caption.index)
        if needed is None:
            return ""
        points = [point for body in needed.grounds for point in self._look_for([body]) or self._recall(body)]
        is_known = len(points) == len(needed.grounds)
        text = captions.grounded(needed.text, points) if is_known else captions.simple(needed.text)
        return f"{text} Subgoal: {self._caption.grounded}."

    def oracle(self, motions: Motions | None = None) -> Iterator[NDArray[np.float32]]:
        """Yields the actions (8,) that solve the episode, each planned from the state in which it is requested.

        Take one, step with it, take the next; stop when the episode ends. ``motions`` are the arm's skills, new ones by
        default; the caller's own may include a failed grasp, and count grasps.
        """
        self._require_episode()
        motions = Motions(self.physics) if motions is None else motions
        if (again := self._to_pick_up_again()) is not None:
            yield from self._subtasks[again].motion(motions)
        for subtask in self._subtasks[self._progress.index :]:
            yield from subtask.motion(motions)

    def save(self) -> EpisodeState:
        """Returns a copy of the current state of the whole episode."""
        self._require_episode()
        assert self._caption is not None
        return EpisodeState(
            task=self.task.name,
            difficulty=self.difficulty,
            layout=self._layout,
            step=self._step,
            physics=self.physics.save(),
            memory=self._memory,
            progress=self._progress,
            caption=self._caption,
            video=self._video,
            actions=tuple(self._actions),
        )

    def restore(self, state: EpisodeState, *, look: bool = True) -> Snapshot:
        """Continues a saved episode and returns its snapshot. Raises TaskError if it is another task's."""
        if state.task != self.task.name:
            raise TaskError(f"the saved episode is of task {state.task!r}; this environment runs {self.task.name!r}")
        self._begin(state.difficulty, state.layout)
        self.physics.load(state.physics)
        self._step, self._memory = state.step, state.memory
        self._progress, self._caption, self._video = state.progress, state.caption, state.video
        self._actions = list(state.actions)
        self._reorder()
        return self._snapshot(look=look)

    def open_cameras(self) -> None:
        """Opens the renderer, as ``reset`` does; not twice. Raises RenderingError."""
        if self._image_px is not None and self._cameras is None:
            self._cameras = Cameras(self.physics, self._image_px)

    def close(self) -> None:
        """Frees the renderer. May be called twice; ``reset`` and ``restore`` open it again."""
        if self._cameras is not None:
            self._cameras.close()
            self._cameras = None

    def __enter__(self) -> Environment:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self, difficulty: str, layout: Any) -> None:
        self.open_cameras()
        self.difficulty, self._layout = difficulty, layout
        self._subtasks = self.task.subtasks(layout)
        self._step, self._memory, self._caption, self._progress = 0, None, None, Progress()
        self._actions = []
        self.physics.reset()
        self.task.arrange(self.physics, layout)
        self.physics.refresh()

    def _reorder(self) -> None:
        """Reorders the subtasks by what has been done, with ``texts_follow``."""
        if self._texts_follow:
            self._subtasks = self.task.subtasks_after(self._layout, self._memory)

    def _observe(self, *, look: bool = True) -> Snapshot:
        """Stages, remembers, judges and captions the current instant of the physics."""
        self.task.stage(self.physics, self._layout, self._memory, self.physics.elapsed_steps() - 1)
        described = self._progress.index  # texts change one step after the engine does
        before, self._memory = self._memory, self.task.remember(self._memory, self.physics, self._layout)
        if self._memory != before:
            self._reorder()
        chosen = self._progress.first_choice
        if chosen is None:
            chosen = self.task.first_choice(self.physics, self._memory, self._layout, self._progress.index)
        self._progress = engine.judge(
            replace(self._progress, first_choice=chosen),
            self._subtasks,
            self.physics,
            self._memory,
            is_accomplished=self.task.is_accomplished(self._memory, self._layout),
        )
        if self._progress.status is Status.ONGOING and self._step >= self._max_steps:
            reason = f"not done after {self._max_steps} steps"
            self._progress = replace(self._progress, status=Status.TIMEOUT, reason=reason)
        if self._progress.index == described and (again := self._to_pick_up_again()) is not None:
            described = again
        subtask = self._subtasks[described]
        caption = captions.follow(self._caption, described, subtask.text, lambda: self._look_for(subtask.grounds))
        if self._texts_follow:
            caption = self._following(caption, subtask)
        if self._progress.status is Status.SUCCESS:
            caption = captions.completed(caption)
        self._caption = caption
        return self._snapshot(look=look)

    def _to_pick_up_again(self) -> int | None:
        """Returns the subtask that picks up what has to be carried now and was dropped; None without ``texts_follow``.

        It holds from when the object lies on the table until it is picked up again. The engine's subtask does not
        change.
        """
        index, physics = self._progress.index, self.physics
        cubes = self._subtasks[index].carries if self._texts_follow else ()
        if not cubes:
            return None
        before = max(at for at in range(index) if self._subtasks[at].grounds == cubes[:1])
        if self._caption is not None and self._caption.index == before:  # it has not been in the hand since
            is_lost = predicates.first_picked(physics, cubes) is None
        else:
            is_lost = predicates.is_dropped(physics, cubes[0]) and not any(map(physics.is_grasped, cubes))
        return before if is_lost else None

    def _following(self, caption: captions.Caption, subtask: Subtask) -> captions.Caption:
        """Returns the caption, with new coordinates if its objects were pushed elsewhere (not lifted) and are seen."""
        now = np.array([self.physics.position_m(body) for body in subtask.grounds]).reshape(-1, 3)
        if caption is not self._caption:
            self._grounded_at = now
            return caption
        moved_m = np.abs(now - self._grounded_at).max(axis=0, initial=0.0)
        was_pushed = moved_m[:2].max() >= _PUSHED_M and moved_m[2] < _PUSHED_M
        if not caption.is_latched or not was_pushed:
            return caption
        points = self._look_for(subtask.grounds)
        if points is None:
            return caption
        self._grounded_at = now
        return replace(caption, grounded=captions.grounded(subtask.text, points))

    def _look_for(self, bodies: Sequence[str]) -> list[captions.Pixel] | None:
        """Returns where the front camera sees bodies, in a 256 px image at any rendered size; None if one is hidden."""
        points = []
        for body in bodies:
            pixels = sight.visible_pixels(self.physics, FRONT, body, IMAGE_PX)
            point = sight.mean_pixel(pixels)
            if point is None:
                return None
            points.append(point)
        return points

    def _recall(self, body: str) -> list[captions.Pixel]:
        """Returns where the video's frames, one a second, last show a body that has not moved since; else empty."""
        now, pose_7 = self.physics.save(), self.physics.pose(body)
        points: list[captions.Pixel] | None = None
        for row in reversed(self._video[::CONTROL_HZ]):
            self.physics.load(row.physics)
            if points or not np.array_equal(self.physics.pose(body), pose_7):
                break
            points = self._look_for([body])
        self.physics.load(now)
        return points or []

    def _demonstrated(self, step: int, row: Row, *, look: bool) -> Snapshot:
        """Returns a frame of the video; the episode's state is restored afterwards."""
        now = self.physics.save()
        self.physics.load(row.physics)
        snapshot = self._seen(step, Progress(), row.caption, look=look, is_demonstration=True)
        self.physics.load(now)
        return snapshot

    def _snapshot(self, *, look: bool = True) -> Snapshot:
        assert self._caption is not None
        return self._seen(self._step, self._progress, self._caption, look=look)

    def _seen(
        self, step: int, progress: Progress, caption: Caption, *, look: bool, is_demonstration: bool = False
    ) -> Snapshot:
        return Snapshot(
            step=step,
            frames=self._cameras.frames() if look and self._cameras is not None else {},
            state=self.physics.state().astype(np.float32),
            command=self.physics.command().astype(np.float32),
            tcp_pose=pose_of(self.physics.tcp_transform()),
            status=progress.status,
            reason=progress.reason,
            simple_subgoal=caption.simple,
            grounded_subgoal=caption.grounded,
            subtask_index=progress.index,
            subgoal_index=caption.index,
            is_demonstration=is_demonstration,
            first_choice=progress.first_choice,
        )

    def _require_episode(self) -> None:
        if self._layout is None:
            raise RuntimeError("no episode has begun; call reset first")


def steps_between(rate_hz: int) -> int:
    """Returns the control steps between two frames of a rate. Raises ValueError unless it divides 20 Hz."""
    if rate_hz < 1 or CONTROL_HZ % rate_hz:
        raise ValueError(f"a video of {CONTROL_HZ} Hz cannot be shown at {rate_hz} Hz; use 1, 2, 4, 5, 10 or 20")
    return CONTROL_HZ // rate_hz


def _checked(action: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (8,):
        raise ValueError(
            f"action has shape {values.shape}; expected (8,): seven joint targets and the gripper's command"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"action {values.tolist()} is not finite")
    return values
