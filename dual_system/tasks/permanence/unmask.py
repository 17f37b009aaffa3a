"""Base of the four unmasking tasks: cubes are shown, covered, perhaps shuffled; then their places must be remembered.

All events have fixed times. Cubes lie bare in observations 0 to 31 and under containers from 32; swaps, if any,
begin at 64. While containers swap they are held in place by script and the cubes are away; each returns under its own
container when the last swap ends. Source: RoboMME's *Unmask tasks at 598e3b4, rules restated.

Kept from upstream on purpose: before observation 32 the containers hover in the sky, and count as lifted. An episode
whose button is pressed by then has failed.

Not kept: a swap starts from where the layout put the containers, and pairs the nearest of those places. Upstream reads
where they are at that instant, which differs only if something has pushed them in the 1.6 s since they were put down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import mujoco

from dual_system.tasks import captions, predicates, swaps
from dual_system.tasks.containers import EMPTY_Z_M, HIDDEN_HALF_M, HIDING_Z_M, add_container
from dual_system.tasks.geometry import Spot, pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.permanence.scenes import LANE_M, SWAP_STEP, Hidden, Layout
from dual_system.tasks.physics import Physics
from dual_system.tasks.scene import CUBE_COLORS, add_button, add_cube
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task

COVER_STEP = 32  # the first observation that shows the containers

_RELEASE_Z_M = 0.07

Pressed = frozenset[str]


class Unmask(Task[Layout, Pressed]):
    """Press the buttons, if there are any, then pick up the containers that hide cubes of given colours.

    The memory is the set of buttons that have been pressed.
    """

    max_containers: ClassVar[int]
    num_buttons: ClassVar[int]
    preamble: ClassVar[str]  # how the instruction begins

    def furnish(self, spec: mujoco.MjSpec) -> None:
        for button in button_names(self.num_buttons):
            add_button(spec, button)
        for index in range(self.max_containers):
            add_container(spec, container_name(index))
        for index in range(len(CUBE_COLORS)):
            add_cube(spec, cube_name(index), HIDDEN_HALF_M)

    def arrange(self, physics: Physics, layout: Layout) -> None:
        for button, xy_m in zip(button_names(self.num_buttons), layout.buttons_xy_m, strict=True):
            physics.place(button, pose(*xy_m, 0.0))
        for cube in layout.hidden:
            physics.paint(cube_name(cube.container), CUBE_COLORS[cube.color])
        _lay_cubes(physics, layout, layout.containers)

    def stage(self, physics: Physics, layout: Layout, memory: Pressed | None, step: int) -> None:
        if step == COVER_STEP:
            _stand_over_cubes(physics, layout, layout.containers)
        elif layout.swaps and SWAP_STEP <= step <= layout.last_event_step:
            spots = swaps.spots_after(layout.containers, layout.swaps, step - SWAP_STEP, LANE_M)
            if step < layout.last_event_step:
                for cube in layout.hidden:
                    physics.park(cube_name(cube.container))
                for index, spot in enumerate(spots):
                    physics.place(container_name(index), spot.pose(EMPTY_Z_M))
            else:
                _lay_cubes(physics, layout, spots)
                _stand_over_cubes(physics, layout, spots)
        else:
            return
        physics.refresh()

    def instruction(self, layout: Layout) -> str:
        first, *others = (cube.color for cube in layout.hidden[: layout.num_picks])
        finally_ = "".join(f", finally pick up another container hiding the {color} cube" for color in others)
        return f"{self.preamble}, then pick up the container hiding the {first} cube{finally_}"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        steps = [*_presses(button_names(self.num_buttons))]
        for nth, cube in enumerate(layout.hidden[: layout.num_picks]):
            if nth > 0:
                steps.append(_putting_down(layout, layout.hidden[nth - 1]))
            steps.append(_picking_up(layout, cube))
        return tuple(steps)

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        if index < self.num_buttons:
            return _before_the_gate(layout, index, self.num_buttons)
        # Picking up and putting down take turns; a container that is put down has made way for the next.
        target = layout.hidden[(index - self.num_buttons + 1) // 2]
        hides = ", ".join(f"{_letter(layout, c.container)} hides the {c.color} cube" for c in layout.hidden)
        pairs = ", ".join(f"{_letter(layout, first)} <-> {_letter(layout, second)}" for first, second in layout.swaps)
        track = f"Track swaps {pairs}" if pairs else "No swaps"
        text = f"Reveal: container {hides}. {track}; final target is {_letter(layout, target.container)}[ at <>]."
        return Reasoning(text=text, grounds=(container_name(target.container),))

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The same containers hid the same cubes in another order; every colour was under another one."""
        places = [cube.container for cube in layout.hidden]
        return tuple(
            replace(
                layout,
                hidden=tuple(
                    replace(cube, container=places[(nth + shift) % len(places)])
                    for nth, cube in enumerate(layout.hidden)
                ),
            )
            for shift in range(1, len(places))
        )

    def cues(self, layout: Layout) -> tuple[str, ...]:
        return tuple(cube_name(cube.container) for cube in layout.hidden)

    def remember(self, memory: Pressed | None, physics: Physics, layout: Layout) -> Pressed:
        now = (button for button in button_names(self.num_buttons) if predicates.is_pressed(physics, button))
        return (memory or frozenset()).union(now)


def watching(layout: Layout) -> tuple[Shown, ...]:
    """A demonstration in which the robot stands still until nothing moves any more."""
    return (Shown(text="static", motion=lambda motions: motions.wait_until(layout.last_event_step)),)


def button_names(num_buttons: int) -> tuple[str, ...]:
    """Returns the names of the buttons, in the order of their places in the layout."""
    return ("button",) if num_buttons == 1 else ("button_left", "button_right")[:num_buttons]


def container_name(index: int) -> str:
    """Returns the name of a layout's container."""
    return f"container_{index}"


def cube_name(container: int) -> str:
    """Returns the name of the cube under a container, one of the first three.

    The name depends on the place alone, so cubes with other colors give the same physics to the last bit.
    """
    return f"cube_{container}"


def _lay_cubes(physics: Physics, layout: Layout, spots: Sequence[Spot]) -> None:
    for cube in layout.hidden:
        physics.place(cube_name(cube.container), pose(*spots[cube.container].xy_m, HIDDEN_HALF_M))


def _stand_over_cubes(physics: Physics, layout: Layout, spots: Sequence[Spot]) -> None:
    covering = {cube.container for cube in layout.hidden}
    for index, spot in enumerate(spots):
        physics.place(container_name(index), spot.pose(HIDING_Z_M if index in covering else EMPTY_Z_M))


def _letter(layout: Layout, index: int) -> str:
    """A container's letter in texts, by its initial place."""
    return captions.letter(index, [spot.y_m for spot in layout.containers])


def _before_the_gate(layout: Layout, num_pressed: int, num_buttons: int) -> Reasoning:
    """While buttons are still to be pressed, containers may be yet to come or on their way."""
    lying = ", ".join(f"the {cube.color} cube[ at <>]" for cube in layout.hidden)
    text = f"Reveal: {lying}. Track what covers each; buttons pressed: {num_pressed} of {num_buttons}."
    return Reasoning(text=text, grounds=tuple(cube_name(cube.container) for cube in layout.hidden))


def _presses(buttons: Sequence[str]) -> list[Subtask]:
    """One press per button, in any order, each counting once. Texts and oracle take the right one first."""
    nths = ("",) if len(buttons) == 1 else ("first ", "second ")
    return [
        Subtask(
            text=f"press the {nth}button[ at <>]",
            grounds=(f"{button}/cap",),
            is_done=partial(_has_pressed, num_buttons),
            motion=_press(button),
        )
        for num_buttons, (nth, button) in enumerate(zip(nths, reversed(buttons), strict=False), start=1)
    ]


def _press(button: str) -> Callable[[Motions], Actions]:
    return lambda motions: motions.press(button)


def _picking_up(layout: Layout, cube: Hidden) -> Subtask:
    container = container_name(cube.container)
    return Subtask(
        text=f"pick up the container[ at <>] that hides the {cube.color} cube",
        grounds=(container,),
        is_done=lambda physics, memory: predicates.is_container_lifted(physics, container),
        failure=partial(_wrong_lift, layout, cube),
        motion=lambda motions: motions.pick_container(container),
    )


def _putting_down(layout: Layout, cube: Hidden) -> Subtask:
    container = container_name(cube.container)
    return Subtask(
        text="put down the container",
        is_done=lambda physics, memory: predicates.is_container_put_down(physics, container),
        failure=partial(_wrong_lift, layout, cube),
        motion=lambda motions: motions.put_down(_RELEASE_Z_M),
    )


def _has_pressed(num_buttons: int, physics: Physics, memory: Pressed) -> bool:
    return len(memory) >= num_buttons


def _wrong_lift(layout: Layout, asked: Hidden, physics: Physics, memory: Pressed) -> str | None:
    for index in range(len(layout.containers)):
        if index != asked.container and predicates.is_container_lifted(physics, container_name(index)):
            colors = [f"the {cube.color} cube" for cube in layout.hidden if cube.container == index]
            hides = colors[0] if colors else "nothing"
            return f"lifted {container_name(index)}, which hides {hides}, not the {asked.color} cube"
    return None
