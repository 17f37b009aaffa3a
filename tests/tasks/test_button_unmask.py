"""ButtonUnmask: what is seen when, what the button gates, and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.containers import EMPTY_Z_M, HIDDEN_HALF_M, HIDING_Z_M
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import Motions
from dual_system.tasks.permanence.button_unmask import ButtonUnmask
from dual_system.tasks.scene import CUBE_COLORS

Until = Callable[[Environment, int], Snapshot]
Hoist = Callable[[Environment, str], Snapshot]
Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
HOME = np.append(panda.HOME_QPOS, 1.0)


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("ButtonUnmask")


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    for seed in range(20):
        layout = ButtonUnmask().sample(np.random.default_rng(seed), difficulty)
        assert len(layout.containers) in {"easy": {3}, "medium": {5}, "hard": range(6, 16)}[difficulty]
        assert layout.num_picks == (2 if difficulty == "hard" else 1)
        assert [cube.container for cube in layout.hidden] == [0, 1, 2]
        assert {cube.color for cube in layout.hidden} == set(CUBE_COLORS)
        ((x_m, y_m),) = layout.buttons_xy_m
        assert abs(x_m + 0.2) <= 0.05
        assert abs(y_m) <= 0.05
        assert layout.swaps == ()


def test_any_color_can_be_asked_for() -> None:
    layouts = [ButtonUnmask().sample(np.random.default_rng(seed), "easy") for seed in range(20)]
    assert {layout.hidden[0].color for layout in layouts} == set(CUBE_COLORS)


def test_cubes_are_bare_until_31_and_covered_from_32_whatever_the_robot_does(env: Environment) -> None:
    snapshot = env.reset(1)
    for _ in range(40):
        for cube in env.layout.hidden:
            spot = env.layout.containers[cube.container]
            cube_m = env.physics.position_m(f"cube_{cube.container}")
            np.testing.assert_allclose(cube_m, [*spot.xy_m, HIDDEN_HALF_M], atol=3e-4)
        for index, spot in enumerate(env.layout.containers):
            container_m = env.physics.position_m(f"container_{index}")
            if snapshot.step < 32:
                assert np.abs(container_m).max() > 5
            else:
                z_m = HIDING_Z_M if index < 3 else EMPTY_Z_M
                np.testing.assert_allclose(container_m, [*spot.xy_m, z_m], atol=3e-4)
        snapshot = env.step(HOME)


def test_containers_that_an_episode_does_not_use_never_show(env: Environment) -> None:
    env.reset(0, "easy")
    for _ in range(40):
        env.step(HOME)
    assert all(np.abs(env.physics.position_m(f"container_{i}")).max() > 5 for i in range(3, 15))


def test_lifting_another_container_fails_with_a_reason(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(0, "easy")
    until_subtask(env, 1)
    snapshot = play(env, Motions(env.physics).pick_container("container_1"))
    assert snapshot.status is Status.FAIL
    asked, other = (env.layout.hidden[i].color for i in (0, 1))
    assert snapshot.reason == f"lifted container_1, which hides the {other} cube, not the {asked} cube"


def test_lifting_an_empty_container_fails_with_a_reason(env: Environment, until_subtask: Until, hoist: Hoist) -> None:
    env.reset(1, "medium")
    until_subtask(env, 1)
    assert (
        hoist(env, "container_4").reason
        == f"lifted container_4, which hides nothing, not the {env.layout.hidden[0].color} cube"
    )


def test_before_the_button_nothing_that_is_lifted_counts(env: Environment, play: Play, hoist: Hoist) -> None:
    env.reset(0, "easy")
    play(env, [HOME] * 35)
    assert hoist(env, "container_1").status is Status.ONGOING
    env.reset(0, "easy")
    play(env, [HOME] * 35)
    snapshot = play(env, Motions(env.physics).pick_container("container_0"))
    assert (snapshot.status, snapshot.subtask_index) == (Status.ONGOING, 0)


def test_quirk_a_button_pressed_while_the_containers_hover_loses(env: Environment) -> None:
    env.reset(0, "easy")
    for _ in range(10):
        env.step(HOME)
    env.restore(replace(env.save(), memory=frozenset({"button"})))
    env.step(HOME)
    assert env.step(HOME).status is Status.FAIL


def test_hard_while_putting_down_another_one_must_stay_where_it_is(
    env: Environment, until_subtask: Until, hoist: Hoist
) -> None:
    env.reset(2, "hard")
    until_subtask(env, 2)
    assert hoist(env, "container_1").status is Status.FAIL


def test_hard_the_first_container_is_not_the_second(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(2, "hard")
    until_subtask(env, 3)
    motions = Motions(env.physics)
    play(env, motions.move(straight_up(env)))
    snapshot = play(env, motions.pick_container("container_0"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason.startswith("lifted container_0, which hides the ")


def straight_up(env: Environment) -> np.ndarray:
    """The tool straight up from here, clear of everything."""
    target = env.physics.tcp_transform()
    target[2, 3] = 0.2
    return target


def test_the_list_and_the_instruction(env: Environment) -> None:
    env.reset(2, "hard")
    first, second = (cube.color for cube in env.layout.hidden[:2])
    assert [subtask.text for subtask in env.subtasks] == [
        "press the button[ at <>]",
        f"pick up the container[ at <>] that hides the {first} cube",
        "put down the container",
        f"pick up the container[ at <>] that hides the {second} cube",
    ]
    assert env.instruction == (
        f"first press the button, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    )


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(snapshot.step)
    for difficulty, upstream_mean in {"easy": 231, "medium": 225, "hard": 378}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.12)
