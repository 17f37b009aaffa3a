"""Goal sets: one start and several goals of which nothing but the demonstration tells which is meant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.goals import GOAL_SETS, draw_goal_scene, twins
from dual_system.tasks.task import TaskError

Built = Callable[..., Any]
every_set = pytest.mark.parametrize("name", GOAL_SETS)


@every_set
def test_twins_start_from_the_same_plan(name: str) -> None:
    for seed in range(5):
        scene = draw_goal_scene(name, seed)
        for other in twins(scene):
            assert other.plan == scene.plan
            assert other.goals == scene.goals
            assert other.instruction != scene.instruction
        assert {scene.goal, *(other.goal for other in twins(scene))} == set(range(len(scene.goals)))


@every_set
def test_every_goal_is_drawn_as_often(name: str) -> None:
    num, k = 400, len(GOAL_SETS[name].choices)
    counts = Counter(draw_goal_scene(name, seed).goal for seed in range(num))
    assert set(counts) == set(range(k))
    assert GOAL_SETS[name].chance == 1 / k
    spread = 4 * np.sqrt(num / k * (1 - 1 / k))
    assert all(abs(count - num / k) < spread for count in counts.values())


@every_set
def test_the_start_says_nothing_about_the_goal(name: str) -> None:
    """A given goal leaves the plan as it is: it was drawn before."""
    k = len(GOAL_SETS[name].choices)
    for seed in range(10):
        assert len({draw_goal_scene(name, seed, goal).plan for goal in [None, *range(k)]}) == 1


@every_set
@pytest.mark.parametrize("seed", range(3))
def test_no_goal_is_reached_at_the_start(built: Built, name: str, seed: int) -> None:
    played = built(name, seed)
    for _ in range(20):
        assert played.fired() is None
        played.settle(0.05)


@every_set
def test_goals_are_of_the_twenty_four_tasks(name: str) -> None:
    scene = draw_goal_scene(name, 0)
    assert len(scene.goals) >= 2
    assert {goal.task for goal in scene.goals} <= set(TASKS)
    assert scene.horizon == max(TASKS[goal.task].horizon for goal in scene.goals)
    assert len({goal.instruction for goal in scene.goals}) == len(scene.goals)


@pytest.mark.parametrize(
    ("name", "moves"),
    [
        (
            "FourKnobs",
            [
                ("stove/rear_left", 1.0),
                ("stove/front_left", -1.0),
                ("stove/front_right", 1.0),
                ("stove/rear_right", 1.0),
            ],
        ),
        ("TwoDrawers", [("left_drawer/slide", -0.33), ("right_drawer/slide", -0.33)]),
        ("SpoutOrWater", [("sink/spout", -0.6), ("sink/spout", 0.6), ("sink/handle", 0.5)]),
        ("WhichLeaf", [("cabinet/left_door", -1.5), ("cabinet/right_door", 1.5)]),
    ],
)
def test_each_goal_has_its_own_deed(built: Built, name: str, moves: list[tuple[str, float]]) -> None:
    played = built(name)
    assert len(moves) == len(played.scene.goals)
    for goal, (joint, value) in enumerate(moves):
        played.reset()
        played.turn(joint, value)
        assert played.fired() == goal


def test_each_object_and_container_is_a_goal(built: Built) -> None:
    played = built("WhatIntoWhich")
    for goal, each in enumerate(played.scene.goals):
        played.reset()
        played.settle(0.2)
        thing, container = (played.bay.objects[n] for n in (each.target.obj, each.target.container))
        middle = played.view.position_m(container.name)
        played.put(thing.name, np.add(middle, [0.0, 0.0, -container.half_m[2] + 0.0075 + thing.half_m[2]]))
        assert played.fired() == goal


def test_pressing_and_serving_are_different_goals(built: Built) -> None:
    played = built("PressOrServe")
    machine = played.bay.fixtures["coffee_machine"]
    top = np.array(machine.start.center_m)
    played.hand_at(np.add(top, [0.0, 0.0, machine.start.half_m + 0.008]))
    assert played.fired() is None
    played.hand_at(np.add(top, [0.0, 0.0, 0.3]))
    assert played.fired() == 0
    played.reset()
    mug = played.bay.objects["obj"]
    played.put("obj", [played.scene.plan.stand.x_m + 0.3, -0.4, 0.92 + mug.half_m[2] - 0.0005])
    assert played.fired() == 1


def test_an_unknown_set_or_goal_is_refused() -> None:
    with pytest.raises(TaskError, match="unknown goal set 'Knobs'; expected one of FourKnobs"):
        draw_goal_scene("Knobs", 0)
    with pytest.raises(TaskError, match="'TwoDrawers' has no goal 2; expected one from 0 to 1"):
        draw_goal_scene("TwoDrawers", 0, 2)
