"""StopCube: a cube shuttles through a target; press the button just as it comes by for the given time.

The cube runs by the step clock, from rest to rest on every pass, whatever the arm does; pressing the button stops it.
Source: RoboMME's StopCube at 598e3b4, rules restated. Difficulty changes nothing.

Upstream lets a stop on the right spot in the wrong pass wait for the list to end and fails it then; here it fails at
once, with the same outcome.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import Array, pose, smoothstep
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import CONTROL_HZ, Physics
from dual_system.tasks.placing import draw_button
from dual_system.tasks.props import PURPLE, add_ghost_cube, add_target
from dual_system.tasks.scene import CUBE_HALF_M, add_button, display_rgba
from dual_system.tasks.task import Reasoning, Subtask, Task, task

NUM_PASSES = 5
PASS_STEPS = (60, 80, 120)  # control steps of one pass of the running cube, whichever is drawn
PRESS_STEPS = 30  # the oracle begins to press so long before the cube is on the target

_TARGET_REACH_M, _TARGET_RADIUS_M, _TARGET_HALF_HEIGHT_M = 0.1, 0.036, 0.005
_LINE_HALF_M, _LINE_TURN_RAD = 0.3, np.deg2rad(30.0)
_Z_M = 0.01  # of the cube's and the target's centre: the cube is half sunk into the table
_VISITS = (2, 3, 4, 5)
_STOPPED_M = 0.06
_CHECKPOINT_STEPS = 100
_BUTTON, _TARGET, _CUBE = "button", "target", "shuttle"


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One StopCube scene. ``heading_rad`` is how far the first pass is turned from +y, ``visit`` the one asked for."""

    button_xy_m: tuple[float, float]
    target_xy_m: tuple[float, float]
    heading_rad: float
    color_linear: tuple[float, float, float]
    pass_steps: int
    visit: int

    def cube_pose(self, elapsed_steps: int) -> Array:
        """Pose (7,) of the running cube after ``elapsed_steps`` control steps."""
        num_passed, within = divmod(min(elapsed_steps, NUM_PASSES * self.pass_steps), self.pass_steps)
        way = smoothstep(within / self.pass_steps)
        along_m = _LINE_HALF_M * (2 * (way if num_passed % 2 == 0 else 1 - way) - 1)
        x_m, y_m = self.target_xy_m
        return pose(x_m - along_m * np.sin(self.heading_rad), y_m + along_m * np.cos(self.heading_rad), _Z_M)

    @property
    def last_step(self) -> int:
        """Control steps from reset to the end of the pass asked for."""
        return self.pass_steps * self.visit

    def num_visited(self, elapsed_steps: int) -> int:
        """Number of times that the running cube has crossed the target after ``elapsed_steps`` control steps."""
        return (2 * elapsed_steps + self.pass_steps) // (2 * self.pass_steps)

    @property
    def checkpoint_steps(self) -> tuple[int, ...]:
        """Ends of the waiting subtasks, in control steps since reset."""
        return (*range(_CHECKPOINT_STEPS, self.press_step, _CHECKPOINT_STEPS), self.press_step)

    @property
    def press_step(self) -> int:
        """Control step at which the oracle begins to press."""
        return self.last_step - self.pass_steps // 2 - PRESS_STEPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """Whether the cube was near the target, and when the button stopped it (control steps since reset)."""

    is_near: bool
    stopped_step: int | None = None
    is_stopped_well: bool = False


@task(family="counting")
class StopCube(Task[Layout, Memory]):
    """Stop the shuttling cube on the target on a given visit."""

    repeats_itself = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        add_target(spec, _TARGET, PURPLE, radius_m=_TARGET_RADIUS_M, half_height_m=_TARGET_HALF_HEIGHT_M)
        add_ghost_cube(spec, _CUBE, CUBE_HALF_M)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        button = draw_button(rng)
        target_x_m, target_y_m = rng.uniform(-_TARGET_REACH_M, _TARGET_REACH_M, 2).tolist()
        red, green, blue = rng.uniform(size=3).tolist()
        return Layout(
            button_xy_m=button.center_m,
            target_xy_m=(target_x_m, target_y_m),
            heading_rad=float(rng.uniform(-_LINE_TURN_RAD, _LINE_TURN_RAD)),
            color_linear=(red, green, blue),
            pass_steps=int(rng.choice(PASS_STEPS)),
            visit=int(rng.choice(_VISITS)),
        )

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        physics.place(_TARGET, pose(*layout.target_xy_m, _Z_M))
        physics.place(_CUBE, layout.cube_pose(0))
        physics.paint(_CUBE, display_rgba((*layout.color_linear, 1)))

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        if memory is None or memory.stopped_step is None:
            physics.place(_CUBE, layout.cube_pose(physics.elapsed_steps()))
            physics.refresh()

    def instruction(self, layout: Layout) -> str:
        nth = captions.ORDINALS[layout.visit - 1]
        return f"press the button to stop the cube just as it reaches the target for the {nth} time"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        failure = partial(_missed, layout)
        return (
            Subtask(
                text="move to the top of the button[ at <>] to prepare",
                grounds=(f"{_BUTTON}/cap",),
                is_done=lambda physics, memory: predicates.is_hovering(physics, _BUTTON),
                failure=failure,
                motion=lambda motions: motions.hover(_BUTTON),
            ),
            *(
                Subtask(
                    text="remain static",
                    is_done=_has_come(checkpoint),
                    failure=failure,
                    motion=_wait_until(checkpoint),
                )
                for checkpoint in layout.checkpoint_steps
            ),
            Subtask(
                text="press the button to stop the cube on the target[ at <>]",
                grounds=(_TARGET,),
                is_done=_has_stopped,
                failure=failure,
                motion=lambda motions: motions.push_down(_BUTTON),
            ),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        # A subtask's index determines when it ends, not when it began, which depends on the arm.
        waits = layout.checkpoint_steps
        is_waiting = 0 < index <= len(waits)
        ends_step = 0 if index == 0 else waits[min(index, len(waits)) - 1]
        done = layout.num_visited(ends_step)
        count = (
            f"Target: {layout.visit}; completed{' when this wait ends' if is_waiting else ''}: {done}; "
            f"remaining: {layout.visit - done}. One visit every {layout.pass_steps / CONTROL_HZ:g} s. "
        )
        text = count + f"Next, stop the cube at the target[ at <>] on visit {layout.visit}."
        return Reasoning(text=text, grounds=(_TARGET,))

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        is_near = predicates.is_near(physics, _CUBE, _TARGET, _STOPPED_M)
        if memory is None:
            return Memory(is_near=is_near)
        if memory.stopped_step is None and predicates.is_pressed(physics, _BUTTON):
            # Upstream checks where the cube was a step before the press, and where the press has stopped it.
            is_stopped_well = is_near and memory.is_near
            return Memory(is_near=is_near, stopped_step=physics.elapsed_steps(), is_stopped_well=is_stopped_well)
        return Memory(is_near=is_near, stopped_step=memory.stopped_step, is_stopped_well=memory.is_stopped_well)


def _has_come(checkpoint: int) -> Callable[[Physics, Memory], bool]:
    return lambda physics, memory: physics.elapsed_steps() >= checkpoint


def _wait_until(checkpoint: int) -> Callable[[Motions], Actions]:
    return lambda motions: motions.wait_until(checkpoint)


def _has_stopped(physics: Physics, memory: Memory) -> bool:
    """The cube has stood still for a step; where it stands is for the failure predicate to judge."""
    return memory.stopped_step is not None and memory.stopped_step < physics.elapsed_steps()


def _missed(layout: Layout, physics: Physics, memory: Memory) -> str | None:
    if memory.stopped_step is None:
        late = physics.elapsed_steps() > layout.last_step
        return f"visit {layout.visit} went by and the cube was not stopped" if late else None
    if not memory.is_stopped_well:
        return "stopped the cube away from the target"
    if not layout.last_step - layout.pass_steps <= memory.stopped_step <= layout.last_step:
        return f"stopped the cube on visit {memory.stopped_step // layout.pass_steps + 1} instead of {layout.visit}"
    return None
