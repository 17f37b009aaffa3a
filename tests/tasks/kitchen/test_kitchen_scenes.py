"""What every scene of the twenty-four tasks keeps, before any robot stands in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.kitchen import objects
from dual_system.tasks.kitchen.bay import ROBOT_STAND
from dual_system.tasks.kitchen.catalogue import (
    TASKS,
    UNSEEN_BY_CATEGORY,
    UNSEEN_BY_PRECISION,
    draw_scene,
)
from dual_system.tasks.task import TaskError, task_names

Built = Callable[..., Any]
every_task = pytest.mark.parametrize("name", TASKS)
SEEDS = (0, 1, 2)
DRAWN_GEOMS = 45  # a software renderer pays for each: three views in 8 ms leave about this many


def test_there_are_twenty_four_tasks_and_two_splits() -> None:
    assert len(TASKS) == 24
    for unseen in (UNSEEN_BY_CATEGORY, UNSEEN_BY_PRECISION):
        assert len(set(unseen)) == 5
        assert set(unseen) <= set(TASKS)


def test_names_that_mean_all_tasks_mean_the_sixteen() -> None:
    assert len(task_names()) == 16
    assert not set(TASKS) & set(task_names())


@every_task
def test_a_scene_follows_from_its_seed(name: str) -> None:
    scenes = [draw_scene(name, seed) for seed in range(6)]
    assert scenes == [draw_scene(name, seed) for seed in range(6)]
    assert all(a.plan != b.plan for i, a in enumerate(scenes) for b in scenes[:i])


@every_task
@pytest.mark.parametrize("split", ["A", "B"])
def test_objects_are_of_the_split(name: str, split: Any) -> None:
    plans = [thing for seed in range(5) for thing in draw_scene(name, seed, split).plan.objects]
    assert plans
    assert {thing.instance for thing in plans} <= set(objects.instances_of(split))


@every_task
def test_an_instruction_is_filled_and_names_what_is_there(name: str) -> None:
    for seed in range(10):
        scene = draw_scene(name, seed)
        assert not set("{}_") & set(scene.instruction)
        target = scene.goals[0].target
        if target.obj:
            assert scene.plan.thing(target.obj).kind in scene.instruction
            kinds = [thing.kind for thing in scene.plan.objects]
            assert kinds.count(scene.plan.thing(target.obj).kind) == 1, "the word could mean another object"


@every_task
@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_moves_and_nothing_is_done_by_itself(built: Built, name: str, seed: int) -> None:
    played = built(name, seed)
    before = played.data.qpos.copy()
    for _ in range(20):
        assert played.fired() is None
        played.settle(0.05)
    moved = np.abs(played.data.qpos - before)
    assert moved.max() < 0.02, [played.model.jnt_qposadr, moved.round(3)]


@every_task
@pytest.mark.parametrize("seed", SEEDS)
def test_things_do_not_start_inside_each_other(built: Built, name: str, seed: int) -> None:
    played = built(name, seed)
    assert min((contact.dist for contact in played.data.contact), default=0.0) > -0.006


@every_task
def test_a_bay_is_cheap_to_draw(built: Built, name: str) -> None:
    assert np.sum(built(name).model.geom_group == 1) <= DRAWN_GEOMS


@every_task
def test_handles_lie_where_the_simulation_has_them(built: Built, name: str) -> None:
    """A handle's grip, turned or drawn by its own formula, stays on its body's bar."""
    played = built(name)
    for fixture in played.bay.fixtures.values():
        for part in _moving(fixture):
            body = played.model.body(int(played.model.jnt_bodyid[played.model.joint(part.joint).id])).id
            played.reset()
            played.turn(part.joint, 0.0)
            local = played.data.xmat[body].reshape(3, 3).T @ (np.array(part.grip_m) - played.data.xpos[body])
            for value in played.model.joint(part.joint).range * 0.7:
                played.turn(part.joint, value)
                there = played.data.xpos[body] + played.data.xmat[body].reshape(3, 3) @ local
                np.testing.assert_allclose(part.at(value)[0], there, atol=1e-9)
    assert played.bay.fixtures


def test_the_robot_stands_in_front_of_what_it_is_asked_for(built: Built) -> None:
    played = built("OpenSingleDoor")
    site = played.data.site(ROBOT_STAND)
    assert site.xpos[0] == played.scene.plan.fixtures[0].x_m
    assert site.xpos[1] == pytest.approx(-0.65 - 0.20)
    np.testing.assert_allclose(site.xmat.reshape(3, 3)[:, 0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_a_drawer_lies_on_the_side_that_is_said(seed: int) -> None:
    plan = (scene := draw_scene("OpenDrawer", seed)).plan
    aside = plan.fixtures[0].x_m - plan.stand.x_m
    assert abs(aside) == pytest.approx(0.55)
    assert plan.stand.y_m == pytest.approx(-0.85 - 0.23)
    assert scene.instruction == f"open the {'right' if aside > 0 else 'left'} drawer"


def test_an_unknown_task_is_refused_with_the_nearest() -> None:
    with pytest.raises(TaskError, match=r"unknown kitchen task 'OpenDraw'\. Did you mean 'OpenDrawer'"):
        draw_scene("OpenDraw", 0)


def test_objects_fit_the_gripper(built: Built) -> None:
    assert 12 <= len(objects.KINDS) <= 20
    seen = [handle for name in TASKS for handle in built(name).bay.objects.values()]
    assert max(handle.grasp_width_m for handle in seen) <= 0.068
    for name, kind in objects.KINDS.items():
        assert len(kind.instances) == 2 * objects.NUM_INSTANCES
        assert len(set(kind.instances)) == len(kind.instances), name


def _moving(fixture: Any) -> list[Any]:
    found = [getattr(fixture, name) for name in ("slide", "spout", "handle", "door") if hasattr(fixture, name)]
    return [*found, *getattr(fixture, "doors", ())]
