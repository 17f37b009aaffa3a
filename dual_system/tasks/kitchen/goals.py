"""Goal sets: scenes in which nothing but the demonstration, or words, tells which of several goals is meant.

The start of a scene is drawn from its seed alone. The goal is drawn afterwards from a stream of its own, so that first
frame and state carry no information about it: episodes of one seed and different goals are twins that start from the
same bits. Every goal of a set can be reached from there, and the first one whose checks hold decides the episode, so
that trying everything is no way: a guess succeeds in one of k cases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dual_system.tasks.kitchen import objects, starts
from dual_system.tasks.kitchen.catalogue import TASKS, goal_of, until_it_fits
from dual_system.tasks.kitchen.drafts import Draft, Span, draft
from dual_system.tasks.kitchen.fixtures.counter import DRAWER_HALF_M
from dual_system.tasks.kitchen.fixtures.stove import KNOBS
from dual_system.tasks.kitchen.plan import Goal, Instances, Scene, Target
from dual_system.tasks.kitchen.starts import OBJ, Start
from dual_system.tasks.task import TaskError

SHOWN_ALONE = "do what was shown"
"""Instruction of every goal set's episodes; the goal's own words are the subgoal."""

_GOAL_STREAM = 1  # of a seed: its second stream draws the goal

Choice = tuple[str, Target, str]
"""One goal of a set: the task that it is, what of the bay it is about, and its instruction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GoalSet:
    """Goals that can be reached from one start. An instruction may hold the kinds of the bay's objects in braces."""

    start: Callable[[np.random.Generator, Instances], Start]
    choices: tuple[Choice, ...]

    @property
    def chance(self) -> float:
        """Success of a guess."""
        return 1.0 / len(self.choices)


def _stove(rng: np.random.Generator, instances: Instances) -> Start:
    """A stove whose knobs are all off; a pan stands on any burner, drawn before the goal."""
    return starts.knob(rng, instances, is_on=False)


def _two_drawers(rng: np.random.Generator, instances: Instances) -> Start:
    """Two shut drawers, as far to the left of the robot as to the right, with an object in each."""
    aside = DRAWER_HALF_M + 0.3
    sides = ("left_drawer", "right_drawer")
    drawn = draft(rng, instances, ["drawer"] * 2, names=sides, offsets_m=(-aside, aside), back_m=starts.DRAWER_BACK_M)
    for name, fixture in zip(("in_left", "in_right"), drawn.fixtures, strict=False):
        starts.put_in_drawer(drawn, name, fixture.x_m, 0.0)
    drawn.distract(int(rng.integers(0, 3)), [(drawn.x_m - 0.5, drawn.x_m + 0.5)], (-0.50, -0.10))
    return Start(draft=drawn, target=Target())


def _sink(rng: np.random.Generator, instances: Instances) -> Start:
    """A sink with the water off, its spout about ahead."""
    start = starts.faucet(rng, instances, is_on=False)
    start.draft.joints["sink/spout"] = float(rng.uniform(-starts.SPOUT_START_RAD, starts.SPOUT_START_RAD))
    return start


def _double_cabinet(rng: np.random.Generator, instances: Instances) -> Start:
    return starts.doors(rng, instances, is_open=False, num=2)


def _two_by_two(rng: np.random.Generator, instances: Instances) -> Start:
    """Two objects and, further apart, two containers on a free counter; who stands where is drawn."""
    drawn = draft(rng, instances, [])
    near: list[Span] = [(drawn.x_m - 0.17, drawn.x_m - 0.09), (drawn.x_m + 0.09, drawn.x_m + 0.17)]
    wide: list[Span] = [(drawn.x_m - 0.42, drawn.x_m - 0.34), (drawn.x_m + 0.34, drawn.x_m + 0.42)]
    kinds = [drawn.draw_kind(objects.DISHES)]
    kinds.append(str(rng.choice([kind for kind in objects.DISHES if kind not in kinds])))
    for name, kind, span in zip((OBJ, "other"), kinds, _shuffled(drawn, near), strict=True):
        drawn.put_somewhere(name, kind, span, (-0.56, -0.48))
    for name, span in zip(("plate", "bowl"), _shuffled(drawn, wide), strict=True):
        drawn.put_somewhere(name, name, span, (-0.46, -0.38))
    return Start(draft=drawn, target=Target(), words=dict(zip((OBJ, "other"), kinds, strict=True)))


def _coffee(rng: np.random.Generator, instances: Instances) -> Start:
    return starts.coffee_serve(rng, instances)


def _shuffled(drawn: Draft, spans: list[Span]) -> list[Span]:
    return spans if drawn.rng.integers(2) else spans[::-1]


GOAL_SETS: Mapping[str, GoalSet] = {
    "FourKnobs": GoalSet(
        start=_stove,
        choices=tuple(
            (
                "TurnOnStove",
                Target(fixture="stove", part=knob),
                f"turn on the {knob.replace('_', ' ')} burner of the stove",
            )
            for knob in KNOBS
        ),
    ),
    "TwoDrawers": GoalSet(
        start=_two_drawers,
        choices=(
            ("OpenDrawer", Target(fixture="left_drawer"), "open the left drawer"),
            ("OpenDrawer", Target(fixture="right_drawer"), "open the right drawer"),
        ),
    ),
    "SpoutOrWater": GoalSet(
        start=_sink,
        choices=(
            ("TurnSinkSpout", Target(fixture="sink", part="left"), "turn the sink spout to the left"),
            ("TurnSinkSpout", Target(fixture="sink", part="right"), "turn the sink spout to the right"),
            ("TurnOnSinkFaucet", Target(fixture="sink"), "turn on the sink faucet"),
        ),
    ),
    "WhichLeaf": GoalSet(
        start=_double_cabinet,
        choices=(
            ("OpenSingleDoor", Target(fixture="cabinet/left_door"), "open the left cabinet door"),
            ("OpenSingleDoor", Target(fixture="cabinet/right_door"), "open the right cabinet door"),
        ),
    ),
    "WhatIntoWhich": GoalSet(
        start=_two_by_two,
        choices=tuple(
            (
                "PnPSinkToCounter",
                Target(obj=thing, container=container),
                f"pick the {{{thing}}} from the counter and place it {on} the {container}",
            )
            for thing in (OBJ, "other")
            for container, on in (("plate", "on"), ("bowl", "in"))
        ),
    ),
    "PressOrServe": GoalSet(
        start=_coffee,
        choices=(
            (
                "CoffeePressButton",
                Target(fixture="coffee_machine"),
                "press the button on the coffee machine to serve coffee",
            ),
            (
                "CoffeeServeMug",
                Target(fixture="coffee_machine", obj=OBJ),
                "pick the mug from under the coffee machine dispenser and place it on the counter",
            ),
        ),
    ),
}


def draw_goal_scene(name: str, seed: int, goal: int | None = None, instances: Instances = "A") -> Scene:
    """Returns the scene of a goal set that a seed draws, with the drawn goal or a given one.

    Raises TaskError for an unknown set or a goal that it does not have.
    """
    if name not in GOAL_SETS:
        raise TaskError(f"unknown goal set {name!r}; expected one of {', '.join(GOAL_SETS)}")
    goal_set = GOAL_SETS[name]
    num = len(goal_set.choices)
    if goal is not None and not 0 <= goal < num:
        raise TaskError(f"goal set {name!r} has no goal {goal}; expected one from 0 to {num - 1}")
    start = until_it_fits(lambda rng: goal_set.start(rng, instances), seed)
    goals = tuple(_goal(choice, start.words) for choice in goal_set.choices)
    horizon = max(TASKS[each.task].horizon for each in goals)
    return Scene(
        task=name,
        seed=seed,
        horizon=horizon,
        plan=start.draft.plan(),
        goals=goals,
        goal=drawn_goal(name, seed) if goal is None else goal,
    )


def drawn_goal(name: str, seed: int) -> int:
    """Returns the goal of a set that a seed draws."""
    return int(np.random.default_rng((seed, _GOAL_STREAM)).integers(len(GOAL_SETS[name].choices)))


def twin_of(name: str, seed: int) -> int:
    """Returns the goal that is shown as the twin of the drawn one; each goal is the twin of one other."""
    return (drawn_goal(name, seed) + 1) % len(GOAL_SETS[name].choices)


def twins(scene: Scene) -> tuple[Scene, ...]:
    """Returns the scenes of the same start with the other goals."""
    return tuple(replace(scene, goal=goal) for goal in range(len(scene.goals)) if goal != scene.goal)


def _goal(choice: Choice, words: Mapping[str, str]) -> Goal:
    task, target, instruction = choice
    return goal_of(task, target, words, instruction=instruction)
