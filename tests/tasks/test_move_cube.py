"""MoveCube: what is drawn, that the scene jumps and only the manner stays, and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks import predicates
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import is_clear
from dual_system.tasks.imitation.move_cube import MANNERS, MoveCube, Scene
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.oracle import Motions
from dual_system.tasks.pegs import peg_footprint

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Deed = Callable[[Motions], Iterator[np.ndarray]]
every_manner = pytest.mark.parametrize("manner", MANNERS)

DEEDS: dict[str, Deed] = {
    "pick the cube": lambda motions: motions.pick("cube"),
    "pick the peg": lambda motions: motions.pick_bar("peg/head"),
    "push": lambda motions: motions.push("cube", "target"),
}


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("MoveCube")


def start(env: Environment, manner: str, seed: int = 3) -> Snapshot:
    layout = MoveCube().sample(np.random.default_rng(seed), "easy")
    return env.reset(seed, layout=replace(layout, manner=manner))


def assert_lies(env: Environment, scene: Scene) -> None:
    np.testing.assert_allclose(env.physics.position_m("cube")[:2], [scene.cube.x_m, scene.cube.y_m], atol=1e-3)
    np.testing.assert_allclose(env.physics.position_m("target")[:2], scene.target_xy_m, atol=1e-9)
    np.testing.assert_allclose(env.physics.position_m("peg")[:2], scene.peg.xy_m, atol=1e-3)


def test_sampled_scenes_obey_the_rules() -> None:
    layouts = [MoveCube().sample(np.random.default_rng(seed), "hard") for seed in range(100)]
    for layout in layouts:
        for scene, reach_m in ((layout.demonstrated, 0.11), (layout.asked, 0.06)):
            cube_xy_m = np.array([scene.cube.x_m, scene.cube.y_m])
            assert np.abs(scene.target_xy_m).max() <= reach_m
            assert np.abs(cube_xy_m).max() <= 0.13
            assert np.hypot(*(cube_xy_m - scene.target_xy_m)) > 0.1 - np.hypot(0.03, 0.03)
            assert abs(scene.peg.x_m) <= 0.05
            assert 0.15 <= abs(scene.peg.y_m) <= 0.25
            assert abs(scene.peg.yaw_rad) <= np.pi / 4
            assert is_clear(peg_footprint(scene.peg, 0.1), scene.cube.footprint, 0.0)
    assert {layout.manner for layout in layouts} == set(MANNERS)
    assert {np.sign(layout.asked.peg.y_m) for layout in layouts} == {-1, 1}


@every_manner
def test_the_video_shows_the_manner_and_then_the_scene_jumps(env: Environment, manner: str) -> None:
    start(env, manner)
    assert_lies(env, env.layout.asked)
    now, video = env.save(), env.save().video
    env.physics.load(video[0].physics)
    assert_lies(env, env.layout.demonstrated)
    is_peg_held, is_cube_held = False, False
    for row in video:
        env.physics.load(row.physics)
        is_peg_held |= predicates.is_picked(env.physics, "peg/tail")
        is_cube_held |= predicates.is_picked(env.physics, "cube")
    assert predicates.is_pushed_onto(env.physics, "cube", "target")
    assert (is_peg_held, is_cube_held) == (manner == "hook", manner == "place")
    env.restore(now)


def test_the_execution_begins_alike_whatever_the_manner(env: Environment) -> None:
    """The point of the task: what is seen now does not say how to move the cube."""
    beginnings = []
    for manner in MANNERS:
        start(env, manner)
        beginnings.append(env.physics.data.qpos.copy())
    for other in beginnings[1:]:
        np.testing.assert_allclose(other, beginnings[0], atol=1e-5)


@pytest.mark.parametrize(
    ("manner", "deed", "reason"),
    [
        ("hook", "pick the cube", "picked up the cube; the video shows another manner"),
        ("hook", "push", "the cube was on the target before anything was picked up; the video shows another manner"),
        ("push", "pick the cube", "picked up the cube; the video shows another manner"),
        ("push", "pick the peg", "picked up the peg; the video shows another manner"),
        ("place", "pick the peg", "picked up the peg; the video shows another manner"),
        ("place", "push", "the cube was on the target before anything was picked up; the video shows another manner"),
    ],
)
def test_another_manner_fails_with_a_reason(env: Environment, play: Play, manner: str, deed: str, reason: str) -> None:
    start(env, manner)
    snapshot = play(env, DEEDS[deed](Motions(env.physics)))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, reason)


@every_manner
def test_the_manner_shown_succeeds(env: Environment, play: Play, manner: str) -> None:
    start(env, manner)
    assert play(env, env.oracle()).status is Status.SUCCESS


def test_the_hook_may_be_held_at_either_end(env: Environment, play: Play) -> None:
    start(env, "hook")
    assert play(env, DEEDS["pick the peg"](Motions(env.physics))).subtask_index == 1


def test_a_pushed_cube_does_not_count_while_the_gripper_is_closed(env: Environment, play: Play) -> None:
    start(env, "push")
    motions = Motions(env.physics)
    play(env, motions.close())
    x_m, y_m, _ = env.physics.position_m("target")
    env.physics.place("cube", np.array([x_m, y_m, 0.02, 1.0, 0.0, 0.0, 0.0]))
    env.physics.refresh()
    assert play(env, motions.hold(2)).status is Status.ONGOING
    assert play(env, motions.open()).status is Status.SUCCESS


def test_the_past_in_words(env: Environment) -> None:
    start(env, "push")
    said = env.reasoning()
    assert said.startswith("Demo sequence: the cube at <")
    assert "; modes: push it with the closed gripper. Reproduce exactly; next is: Close the gripper and push" in said


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps = []
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps.append(len(env.save().video) + snapshot.step)
    assert len(steps) >= 98
    assert np.mean(steps) == pytest.approx(394, rel=0.12)


def test_a_scene_whose_video_the_arm_cannot_act_out_is_drawn_again(env: Environment) -> None:
    seed = 710_001
    rng = np.random.default_rng(seed)
    first, *others = [MoveCube().sample(rng, "hard") for _ in range(4)]
    with pytest.raises(UnreachableError):
        env.reset(seed, "hard", layout=first)
    env.reset(seed, "hard")
    assert env.layout in others
