"""What scripts plan with: paths looked at between their ends, corners of a way, and grips on what has fallen."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.tasks.kitchen import places, steps
from dual_system.tasks.kitchen.arm import _FREE, Arm
from dual_system.tasks.kitchen.catalogue import draw_scene
from dual_system.tasks.kitchen.grips import grips_on
from dual_system.tasks.kitchen.reach import UNREACHABLE, Leg, Reach
from dual_system.tasks.kitchen.steps import AHEAD, RIGHT, UP
from dual_system.tasks.kitchen.world import World

AT_HOME = (0.0, 0.0)


@pytest.fixture(scope="module")
def world() -> World:
    return World(draw_scene("PnPMicrowaveToCounter", 0))


def test_a_path_through_a_wall_is_worth_less_than_the_way_around(world: World) -> None:
    reach, here = Reach(world.view), steps.here(world.view)
    x, y = world.bay.plan.stand.x_m, -0.55  # in front of the microwave
    front = here.copy()
    front[:3, 3] = x, y, 1.1
    inside = steps.moved(front, 0.3 * AHEAD + 0.15 * RIGHT)
    free = reach.follow([Leg(base=AT_HOME, poses=(front, here))])
    through = reach.follow([Leg(base=AT_HOME, poses=(front, inside, front))])
    assert free > 0.0
    assert through < free


def test_a_path_out_of_reach_is_unreachable(world: World) -> None:
    far = steps.moved(steps.here(world.view), 2.0 * RIGHT)
    assert Reach(world.view).follow([Leg(base=AT_HOME, poses=(far,))]) <= UNREACHABLE


def test_a_floor_does_not_change_what_is_above_it(world: World) -> None:
    reach, here = Reach(world.view), steps.here(world.view)
    path = [Leg(base=AT_HOME, poses=(steps.moved(here, 0.1 * UP),))]
    assert reach.follow(path, UNREACHABLE) == reach.follow(path)


@given(worths=st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=6), alike=st.floats(0.0, 0.5))
def test_the_first_free_path_is_taken_or_the_first_of_those_like_the_best(worths: list[float], alike: float) -> None:
    arm: Any = Arm.__new__(Arm)
    arm._reach = SimpleNamespace(follow=lambda worth, floor: worth)
    enough = _FREE if max(worths) > _FREE else max(worths) - alike
    assert arm.first_free(worths, alike=alike) == [worth > _FREE or worth >= enough for worth in worths].index(True)


def test_a_way_around_goes_sideways_nearest_to_the_robot() -> None:
    T, there = np.eye(4), np.eye(4)
    T[:3, 3], there[:3, 3] = (0.0, -0.6, 1.0), (0.5, -0.3, 1.2)
    (corner,) = steps.around(T, there)
    np.testing.assert_allclose(corner[:3, 3], (0.5, -0.6, 1.2))
    (corner,) = steps.around(there, T)
    np.testing.assert_allclose(corner[:3, 3], (0.5, -0.6, 1.2))
    assert steps.around(T, steps.moved(T, 0.3 * AHEAD)) == []


def test_a_bottle_that_has_fallen_is_grasped_across(built: Callable[..., Any]) -> None:
    played = built("PnPCounterToCab", _seed_with("bottle"))
    view, thing = played.view, played.bay.objects["obj"]
    first = int(played.model.joint("obj").qposadr[0])
    played.put("obj", (0.0, -0.4, 0.95))
    upright = places.half_height_m(view, "obj")
    played.data.qpos[first + 3 : first + 7] = np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0  # its axis along x
    played.settle(0.01)
    assert places.half_height_m(view, "obj") < upright
    (T,) = grips_on(view, thing, 0.0)
    assert abs(T[:3, 1] @ AHEAD) > 0.99


def _seed_with(kind: str) -> int:
    for seed in range(200):
        scene = draw_scene("PnPCounterToCab", seed)
        if any(each.name == "obj" and each.kind == kind for each in scene.plan.objects):
            return seed
    raise AssertionError(f"no {kind} among the first seeds")
