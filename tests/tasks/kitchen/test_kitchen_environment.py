"""Laws that every kitchen task keeps: as `test_contract` for the sixteen."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Snapshot
from dual_system.tasks.kitchen import environment as kitchen
from dual_system.tasks.kitchen import gr1, puppet
from dual_system.tasks.kitchen.catalogue import TASKS, draw_scene
from dual_system.tasks.kitchen.environment import KitchenEnvironment, instances_of
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.kitchen.layout import ACTION, NUM_ACTION, NUM_STATE, STATE
from dual_system.tasks.kitchen.omron import VIEWS
from dual_system.tasks.kitchen.plan import Scene
from dual_system.tasks.task import TaskError

SEED = 0
every_task = pytest.mark.parametrize("name", [*TASKS, *GOAL_SETS])
OF_EACH_KIND = ("OpenDrawer", "CoffeeServeMug", "TurnOnStove", "PnPCounterToCab", "TurnSinkSpout")
"""Tasks whose goals and fixtures are of different kinds."""
WAIT = np.zeros(NUM_ACTION)
EnvironmentOf = Callable[[str], KitchenEnvironment]


@pytest.fixture(scope="module")
def environment() -> EnvironmentOf:
    return functools.cache(lambda name: KitchenEnvironment(name, render=False))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Waited:
    """Half a second of an episode in which nothing was done."""

    first: Snapshot
    scene: Scene
    instruction: str
    last: Snapshot


@pytest.fixture(scope="module")
def waited(environment: EnvironmentOf) -> Callable[[str], Waited]:
    @functools.cache
    def wait(name: str) -> Waited:
        env = environment(name)
        first = env.reset(SEED)
        last = [env.step(WAIT) for _ in range(10)][-1]
        return Waited(first=first, scene=env.scene, instruction=env.instruction, last=last)

    return wait


@every_task
def test_the_first_snapshot_is_well_formed(waited: Callable[[str], Waited], name: str) -> None:
    first, instruction = waited(name).first, waited(name).instruction
    assert first.status is Status.ONGOING
    assert first.state.shape == (NUM_STATE,)
    assert first.command.shape == (NUM_ACTION,)
    assert np.isfinite(first.state).all()
    assert first.step == 0
    assert "{" not in instruction
    assert len(instruction) > 10


@every_task
def test_a_seed_draws_one_episode_and_another_seed_another(
    waited: Callable[[str], Waited], environment: EnvironmentOf, name: str
) -> None:
    once, env = waited(name), environment(name)
    again = env.reset(SEED)
    np.testing.assert_array_equal(once.first.state, again.state)
    assert env.scene == once.scene
    env.reset(SEED + 1)
    assert env.scene.plan != once.scene.plan


@every_task
def test_waiting_reaches_no_goal_and_moves_nothing_much(waited: Callable[[str], Waited], name: str) -> None:
    first, last = waited(name).first, waited(name).last
    assert last.status is Status.ONGOING
    np.testing.assert_allclose(last.state[STATE["eef_pos"]], first.state[STATE["eef_pos"]], atol=2e-3)


@pytest.mark.parametrize(
    "name",
    [
        name if name in OF_EACH_KIND else pytest.param(name, marks=pytest.mark.acceptance)
        for name in (*TASKS, *GOAL_SETS)
    ],
)
def test_a_saved_episode_continues_exactly_elsewhere(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    env.reset(SEED)
    actions = list(islice(env.oracle(), 1))  # the script's first, then a base that drives: a goal that is remembered
    drive = WAIT.copy()
    drive[ACTION["base_velocity"]], drive[ACTION["mode"]] = (-0.6, 0.0, 0.0), 1.0
    for action in (*actions, drive, drive):
        env.step(action)
    saved = env.save()
    here = [env.step(drive).state for _ in range(5)]
    with KitchenEnvironment(name, render=False) as other:
        assert other.restore(saved).step == saved.step
        there = [other.step(drive).state for _ in range(5)]
    np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(
    ("action", "complaint"),
    [
        (np.zeros(8), r"shape \(8,\); expected \(12,\)"),
        (np.append(np.zeros(11), np.nan), "is not finite"),
    ],
)
def test_a_bad_action_is_refused_and_changes_nothing(
    environment: EnvironmentOf, action: np.ndarray, complaint: str
) -> None:
    env = environment("OpenDrawer")
    env.reset(SEED)
    before = env.world.data.qpos.copy()
    with pytest.raises(ValueError, match=complaint):
        env.step(action)
    np.testing.assert_array_equal(env.world.data.qpos, before)


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises(TaskError, match="unknown kitchen task 'OpenDoor'; expected one of PnPCounterToCab"):
        KitchenEnvironment("OpenDoor")


def test_a_task_has_one_goal(environment: EnvironmentOf) -> None:
    with pytest.raises(ValueError, match="OpenDrawer has one goal"):
        environment("OpenDrawer").reset(SEED, goal=1)


@pytest.mark.parametrize("name", GOAL_SETS)
def test_the_goals_of_a_set_begin_in_one_state(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    starts = [env.reset(SEED, goal=goal).state for goal in (0, 1)]
    np.testing.assert_array_equal(*starts)


def test_held_out_scenes_show_held_out_instances() -> None:
    assert [instances_of(seed) for seed in (0, 500_000, 800_000, 1_000_000, 2_000_000)] == ["A", "B", "B", "A", "A"]


def test_an_episode_times_out_and_then_takes_no_action() -> None:
    with KitchenEnvironment("OpenDrawer", render=False, max_steps=3) as env:
        env.reset(SEED)
        assert [env.step(WAIT).status for _ in range(3)] == [Status.ONGOING] * 2 + [Status.TIMEOUT]
        with pytest.raises(RuntimeError, match="ended with timeout at step 3"):
            env.step(WAIT)


@pytest.mark.parametrize(
    "name", ["OpenDrawer", pytest.param("CoffeePressButton", marks=pytest.mark.acceptance), "TurnSinkSpout"]
)
def test_the_script_reaches_the_goal(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    last = env.reset(SEED)
    assert env.goal_done is None
    for action in env.oracle():
        assert action.shape == (NUM_ACTION,)
        last = env.step(action)
        if last.status is not Status.ONGOING:
            break
    assert last.status is Status.SUCCESS
    assert last.step < draw_scene(name, SEED).horizon
    assert env.goal_done == 0
    assert len(env.rehearse()) == last.step + 1  # what is shown is what was done, to the step


def test_another_goal_of_the_set_ends_the_episode() -> None:
    name = next(iter(GOAL_SETS))
    with KitchenEnvironment(name, render=False) as env:
        env.reset(SEED, goal=1)
        twin = env.scene
        script = kitchen.perform(env.world, kitchen.script(twin.goals[0], env.world.view))
        for action in script:
            last = env.step(action)
            if last.status is not Status.ONGOING:
                break
        assert last.status is Status.FAIL
        assert last.first_choice is False
        assert env.goal_done == 0
        assert twin.goals[0].instruction in last.reason


@pytest.mark.sim
def test_three_views_of_the_robot_and_one_of_the_demonstration() -> None:
    with KitchenEnvironment("OpenDrawer") as env:
        first = env.reset(SEED)
        assert tuple(first.frames) == VIEWS
        for picture in first.frames.values():
            assert picture.shape == (kitchen.IMAGE_PX, kitchen.IMAGE_PX, 3)
            assert picture.std() > 10
        before = env.save()
        video = list(env.demonstration(1))
        assert 4 < len(video) < 30
        assert all(frame.is_demonstration and tuple(frame.frames) == (puppet.CAMERA,) for frame in video)
        moved = np.abs(video[0].frames[puppet.CAMERA].astype(int) - video[-1].frames[puppet.CAMERA].astype(int))
        assert moved.mean() > 2
        after = env.save()
        np.testing.assert_array_equal(after.world.integration, before.world.integration)


@pytest.mark.parametrize("rate_hz", [0, 3, 40])
def test_a_video_has_no_frames_between_its_frames(environment: EnvironmentOf, rate_hz: int) -> None:
    env = environment("OpenDrawer")
    env.reset(SEED)
    with pytest.raises(ValueError, match=f"cannot be shown at {rate_hz} Hz"):
        next(env.demonstration(rate_hz))


def test_the_puppets_hand_goes_where_the_tool_went_and_the_scene_moves_as_it_did() -> None:
    scene = draw_scene("OpenDrawer", SEED)
    world = kitchen.World(scene)
    moments = puppet.record(world, kitchen.perform(world, kitchen.script(scene.goals[0], world.view)))
    body = puppet.Puppet(scene, "drawers")
    poses = body.poses(moments)
    assert len(poses) == len(moments)
    drawer = body.model.joint("drawer/slide").qposadr[0]
    travel = []
    for k in range(40, len(poses), 20):
        body.pose(poses[k])
        hand = body.data.site(gr1.TOOL_SITE).xpos
        assert np.linalg.norm(hand - moments[k].tool[:3, 3]) < 0.05
        travel.append(float(body.data.qpos[drawer]))
    assert travel[0] == pytest.approx(0.0, abs=1e-3)
    assert travel[-1] == pytest.approx(world.view.angle("drawer/slide"), abs=0.02)
    assert travel[-1] < -0.2


def test_the_puppet_stands_on_the_floor_and_touches_nothing() -> None:
    body = puppet.Puppet(draw_scene("OpenDrawer", SEED), "drawers")
    puppets = [
        g
        for g in range(body.model.ngeom)
        if body.model.body_rootid[body.model.geom_bodyid[g]] == body.model.body(gr1.ROOT_BODY).id
    ]
    assert len(puppets) > 30
    assert not any(body.model.geom_contype[g] or body.model.geom_conaffinity[g] for g in puppets)
    kitchen.puppet.Puppet.pose(body, body.data.qpos.copy())
    feet = body.data.body("r_foot_roll").xpos[2]
    assert 0.0 < feet < 0.15
