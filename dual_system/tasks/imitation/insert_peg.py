"""InsertPeg: a video shows one of three equal pegs grasped at one end and put into a box from one side; do the same.

After the video the pegs lie where they lay before. Source: RoboMME's InsertPeg at 598e3b4, rules restated. Difficulty
changes nothing. "Left" and "right" are the robot's: from the left means that the hand comes from larger y.

Kept from upstream on purpose: the used peg is always peg_0; pegs are turned by at most 45 degrees, so that the head is
always the far end; the box's lamp lights up for 20 steps, but success ends the episode before it is seen again.

Not kept: upstream draws scenes until its planner solves one, and drives the hand against the box in the end. Here pegs
and box lie clear of each other and of the hand, where the arm can reach them, and the hand stops short of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import Array, Footprint, Spot, is_clear, transform
from dual_system.tasks.oracle import Motions
from dual_system.tasks.panda import BASE_POSITION_M
from dual_system.tasks.pegs import (
    BOX_HALF_M,
    BOX_RGBA,
    BOX_Z_M,
    PEG_HALF_WIDTH_M,
    add_box_with_hole,
    add_peg,
    peg_footprint,
)
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import Point, until_it_fits
from dual_system.tasks.props import RED
from dual_system.tasks.scene import SceneFullError, display_rgba
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task, task

NUM_PEGS = 3
ENDS = {"head": "far", "tail": "near"}  # seen from the robot
SIDES = {"left": 1.0, "right": -1.0}  # the sign of y
LIT_STEPS = 20
STILL_STEPS = 100  # not recorded: the robot is at home, the pegs have been put back

_BOX_REACH_M, _BOX_YAW_RAD = 0.1, np.deg2rad(20.0)
_PEG_REACH_M, _PEG_YAW_RAD = (0.2, 0.3), np.pi / 4
_PEG_FROM_BOX_M, _PEG_FROM_PEG_M, _MAX_TRIES = 0.06, 0.075, 512
_PEG_HALF_LENGTH_M = 0.05
_BETWEEN_ENDS_M = 0.05  # their centres
# Offsets of the leading end from the hole: out of the box, above it, beside it.
_APPROACH = ((0.2, 0.15, 0.0), (0.2, 0.0, 0.0), (0.15, 0.0, 0.0), (0.025, 0.0, 0.0))
_STRAYING = ((0.1, 0.0, 0.015), (0.1, 0.0, 0.0))
_ARM_REACH_M = 0.78  # from the base to a tool that points straight down
_GAP_M, _FINGERS_HALF_M, _HAND_HALF_M = 0.005, (0.012, 0.065), (0.035, 0.105)
_BOX, _LAMP = "box", "box/core"
_PEGS = tuple(f"peg_{i}" for i in range(NUM_PEGS))
_OTHERS = tuple(f"{peg}/{end}" for peg in _PEGS[1:] for end in ENDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One InsertPeg scene; ``grasped`` is one of ENDS and ``side`` one of SIDES, both of the first peg."""

    box: Spot  # the hole runs along its x axis
    pegs: tuple[Spot, ...]  # the head is towards their x axis
    head_linear: tuple[float, float, float]  # the tail has the complementary color
    grasped: str
    side: str

    @property
    def held_end(self) -> str:
        """The body that is to be between the fingers."""
        return f"{_PEGS[0]}/{self.grasped}"

    @property
    def leading_end(self) -> str:
        """The body that is to go in."""
        return f"{_PEGS[0]}/{'tail' if self.grasped == 'head' else 'head'}"

    @property
    def outward(self) -> Array:
        """Unit direction (3,) of the hole's axis, out of the box towards the side that the hand comes from."""
        axis = transform(self.box.pose(BOX_Z_M))[:3, 0]
        return axis if axis[1] * SIDES[self.side] > 0 else -axis

    def approach(self, strays_by: int = 0) -> list[Array]:
        """Where (4, 4) the held end is carried: in front of the box and above, down, close, and in.

        With ``strays_by`` 1 or -1 it comes closer beside the hole first, and goes aside until it is in front of it.
        """
        turned = np.eye(4)
        x = self.outward if self.grasped == "head" else -self.outward
        turned[:3, 0], turned[:3, 1] = x, np.cross(turned[:3, 2], x)
        poses = []
        for out_m, above_m, aside_m in (*_APPROACH[:-1], *(_STRAYING if strays_by else ()), *_APPROACH[-1:]):
            held = turned.copy()
            held[:3, 3] = np.array([*self.box.xy_m, BOX_Z_M + above_m]) + (out_m + _BETWEEN_ENDS_M) * self.outward
            held[:3, 3] += strays_by * aside_m * turned[:3, 1]
            poses.append(held)
        return poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """How many steps ago the peg was last in the box as asked; None before it ever was."""

    steps_since_in: int | None = None


@task(family="imitation")
class InsertPeg(Task[Layout, Memory]):
    """Grasp the same end of the same peg as in the video and insert it into the same side of the box."""

    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_box_with_hole(spec, _BOX)
        for peg in _PEGS:
            add_peg(spec, peg, _PEG_HALF_LENGTH_M, (1.0, 1.0, 1.0, 1.0))

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BOX, layout.box.pose(BOX_Z_M))
        red, green, blue = layout.head_linear
        for peg in _PEGS:
            physics.paint(f"{peg}/head", display_rgba((red, green, blue, 1.0)))
            physics.paint(f"{peg}/tail", display_rgba((1.0 - red, 1.0 - green, 1.0 - blue, 1.0)))
        _lay_pegs(layout)(physics)

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        since = memory.steps_since_in if memory else None
        physics.paint(_LAMP, RED if since is not None and since <= LIT_STEPS else BOX_RGBA)

    def instruction(self, layout: Layout) -> str:
        return (
            "watch the video carefully, then grasp the same end of the same peg you've picked before "
            "and insert it into the same side of the box"
        )

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        held, leading = layout.held_end, layout.leading_end
        return (
            Subtask(
                text=f"Pick up the peg by grasping the {ENDS[layout.grasped]} end[ at <>]",
                grounds=(held,),
                is_done=lambda physics, memory: predicates.is_lifted_by(physics, held, leading),
                failure=_wrong_grasp(layout),
                motion=lambda motions: motions.pick_bar(held, onward=layout.approach()),
            ),
            Subtask(
                text=f"Insert the peg from the {layout.side} side[ at <>]",
                grounds=(_BOX,),
                is_done=lambda physics, memory: _is_in(layout, physics),
                failure=_wrong_insertion(layout),
                motion=lambda motions: motions.carry(held, layout.approach(motions.strays_by)),
            ),
        )

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        pick, insert = self.subtasks(layout)
        return (
            Shown(text=pick.text, grounds=pick.grounds, motion=pick.motion),
            Shown(
                text=f"Insert the peg from the {layout.side} side of the box[ at <>]",
                grounds=insert.grounds,
                motion=insert.motion,
            ),
            # Straight home from there, as upstream goes, the hand would catch on the box.
            Shown(text="let go", motion=Motions.let_go, is_recorded=False),
            Shown(text="go home", motion=Motions.go_home, is_recorded=False, afterwards=_lay_pegs(layout)),
            Shown(text="static", motion=lambda motions: motions.wait(STILL_STEPS), is_recorded=False),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        return Reasoning(
            text="Demo sequence: the peg[ at <>], the box[ at <>]; "
            f"modes: grasp the {ENDS[layout.grasped]} end, insert from the {layout.side} side. "
            f"Reproduce exactly; next is: {captions.simple(self.subtasks(layout)[index].text)}.",
            grounds=(layout.held_end, _BOX),
        )

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The peg was grasped at the other end, or inserted from the other side, or both, as far as there is room."""
        others = (replace(layout, grasped=grasped, side=side) for side in SIDES for grasped in ENDS)
        return tuple(other for other in others if other != layout and _has_room(other))

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        if _is_in(layout, physics):
            return Memory(steps_since_in=0)
        since = memory.steps_since_in if memory else None
        return Memory(steps_since_in=None if since is None else since + 1)


def _draw(rng: np.random.Generator) -> Layout:
    head = rng.uniform(size=3).tolist()
    box_x_m, box_y_m = rng.uniform(-_BOX_REACH_M, _BOX_REACH_M, 2).tolist()
    box = Spot(x_m=box_x_m, y_m=box_y_m, yaw_rad=float(np.pi / 2 + rng.uniform(-_BOX_YAW_RAD, _BOX_YAW_RAD)))
    pegs: list[Spot] = []
    for _ in _PEGS:
        pegs.append(_draw_peg(rng, box, pegs))
    layout = Layout(
        box=box,
        pegs=tuple(pegs),
        head_linear=(head[0], head[1], head[2]),
        grasped=str(rng.choice(list(ENDS))),
        side=str(rng.choice(list(SIDES))),
    )
    if not _has_room(layout):
        raise SceneFullError("the hand cannot get at the peg or to the box. Draw the scene again.")
    return layout


def _draw_peg(rng: np.random.Generator, box: Spot, others: list[Spot]) -> Spot:
    """Draws a peg clear of the box and of the pegs before it. Raises SceneFullError after 512 tries."""
    taken = [_box_footprint(box), *(peg_footprint(other, _PEG_HALF_LENGTH_M) for other in others)]
    for _ in range(_MAX_TRIES):
        x_m, y_m = (float(rng.uniform(-reach_m, reach_m)) for reach_m in _PEG_REACH_M)
        peg = Spot(x_m=x_m, y_m=y_m, yaw_rad=float(rng.uniform(-_PEG_YAW_RAD, _PEG_YAW_RAD)))
        if (
            _apart_m(peg.xy_m, box.xy_m) > _PEG_FROM_BOX_M
            and all(_apart_m(peg.xy_m, other.xy_m) > _PEG_FROM_PEG_M for other in others)
            and all(is_clear(peg_footprint(peg, _PEG_HALF_LENGTH_M), other, _GAP_M) for other in taken)
        ):
            return peg
    raise SceneFullError(f"no place for a peg after {_MAX_TRIES} tries. Draw the scene again.")


def _end_m(peg: Spot, end: str) -> tuple[float, float, float]:
    """Where the middle of one of ENDS lies."""
    axis = np.array([np.cos(peg.yaw_rad), np.sin(peg.yaw_rad)])
    x_m, y_m = np.array(peg.xy_m) + (1.0 if end == "head" else -1.0) * _BETWEEN_ENDS_M / 2 * axis
    return float(x_m), float(y_m), PEG_HALF_WIDTH_M


def _has_room(layout: Layout) -> bool:
    """True if the arm reaches the peg and the box, and the open hand finds room to grasp."""
    peg, *others = layout.pegs
    x_m, y_m, _ = _end_m(peg, layout.grasped)
    grasp_xy_m, outermost_xy_m = (x_m, y_m), layout.approach()[0][:2, 3]
    fingers, hand = (
        Footprint(center_m=grasp_xy_m, half_m=half_m, yaw_rad=peg.yaw_rad) for half_m in (_FINGERS_HALF_M, _HAND_HALF_M)
    )
    is_free = is_clear(hand, _box_footprint(layout.box), _GAP_M) and all(
        is_clear(fingers, peg_footprint(other, _PEG_HALF_LENGTH_M), _GAP_M) for other in others
    )
    farthest_m = max(_apart_m(xy_m, BASE_POSITION_M[:2]) for xy_m in (grasp_xy_m, outermost_xy_m))
    return is_free and farthest_m <= _ARM_REACH_M


def _box_footprint(box: Spot) -> Footprint:
    return Footprint(center_m=box.xy_m, half_m=BOX_HALF_M, yaw_rad=box.yaw_rad)


def _apart_m(a_xy_m: Point | Array, b_xy_m: Point | Array) -> float:
    return float(np.hypot(*np.subtract(a_xy_m, b_xy_m)))


def _lay_pegs(layout: Layout) -> Callable[[Physics], None]:
    def lay(physics: Physics) -> None:
        for name, peg in zip(_PEGS, layout.pegs, strict=True):
            physics.place(name, peg.pose(PEG_HALF_WIDTH_M))

    return lay


def _is_in(layout: Layout, physics: Physics) -> bool:
    """The leading end is in the box, and the hand on the side asked for."""
    is_inserted = predicates.is_inserted(physics, layout.leading_end, layout.held_end, _BOX)
    return is_inserted and _side_of_hand(physics) == layout.side


def _side_of_hand(physics: Physics) -> str:
    return "left" if physics.tcp_transform()[1, 3] > physics.position_m(_BOX)[1] else "right"


def _wrong_grasp(layout: Layout) -> Callable[[Physics, Memory], str | None]:
    wrong = "near" if ENDS[layout.grasped] == "far" else "far"

    def failure(physics: Physics, memory: Memory) -> str | None:
        if predicates.is_lifted_by(physics, layout.leading_end, layout.held_end):
            return f"lifted the peg by its {wrong} end; the video shows the other one"
        return _other_peg(physics)

    return failure


def _wrong_insertion(layout: Layout) -> Callable[[Physics, Memory], str | None]:
    def failure(physics: Physics, memory: Memory) -> str | None:
        if predicates.is_inserted(physics, layout.held_end, layout.leading_end, _BOX):
            return "inserted the end that the video shows between the fingers"
        is_inserted = predicates.is_inserted(physics, layout.leading_end, layout.held_end, _BOX)
        if is_inserted and _side_of_hand(physics) != layout.side:
            return f"inserted the peg from the {_side_of_hand(physics)} side; the video shows the other one"
        return _other_peg(physics)

    return failure


def _other_peg(physics: Physics) -> str | None:
    name = predicates.first_picked(physics, _OTHERS)
    return None if name is None else f"picked up {name.split('/')[0]}; the video shows another peg"
