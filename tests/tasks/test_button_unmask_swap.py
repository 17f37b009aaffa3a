"""ButtonUnmaskSwap: two buttons in any order, a shuffle that waits for neither, and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from dual_system.tasks import panda, swaps
from dual_system.tasks.containers import EMPTY_Z_M, HIDING_Z_M
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import Motions
from dual_system.tasks.permanence.button_unmask_swap import ButtonUnmaskSwap
from dual_system.tasks.permanence.scenes import LANE_M

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]
Hoist = Callable[[Environment, str], Snapshot]

HOME = np.append(panda.HOME_QPOS, 1.0)


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("ButtonUnmaskSwap")


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [ButtonUnmaskSwap().sample(np.random.default_rng(seed), difficulty) for seed in range(60)]
    assert {len(layout.containers) for layout in layouts} == {3 if difficulty == "easy" else 4}
    assert {len(layout.swaps) for layout in layouts} == ({2, 3} if difficulty == "hard" else {1, 2})
    assert {layout.num_picks for layout in layouts} == {"easy": {1, 2}, "medium": {1}, "hard": {2}}[difficulty]
    for layout in layouts:
        for (x_m, y_m), center_y_m in zip(layout.buttons_xy_m, (-0.1, 0.1), strict=True):
            assert max(abs(x_m + 0.2), abs(y_m - center_y_m)) <= 0.025


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_containers_swap_by_the_clock_and_cubes_are_away_meanwhile(env: Environment, seed: int) -> None:
    snapshot = env.reset(seed)
    layout = env.layout
    while snapshot.step < layout.last_event_step + 2:
        snapshot = env.step(HOME)
        if snapshot.step < 64:
            continue
        is_over = snapshot.step >= layout.last_event_step
        spots = swaps.spots_after(layout.containers, layout.swaps, snapshot.step - 64, LANE_M)
        for index, spot in enumerate(spots):
            covers = is_over and index in {cube.container for cube in layout.hidden}
            container_m = env.physics.position_m(f"container_{index}")
            np.testing.assert_allclose(container_m, [*spot.xy_m, HIDING_Z_M if covers else EMPTY_Z_M], atol=3e-4)
        for cube in layout.hidden:
            assert (np.abs(env.physics.position_m(f"cube_{cube.container}")).max() < 1) == is_over


def test_the_buttons_may_be_pressed_in_any_order(env: Environment, play: Play) -> None:
    env.reset(1, "medium")
    motions = Motions(env.physics)
    assert play(env, motions.press("button_left")).subtask_index == 1
    assert play(env, motions.press("button_right")).subtask_index == 2


def test_one_button_twice_is_not_two(env: Environment, play: Play) -> None:
    env.reset(1, "medium")
    motions = Motions(env.physics)
    assert play(env, motions.press("button_right")).subtask_index == 1
    assert play(env, motions.press("button_right")).subtask_index == 1


def test_lifting_another_container_fails_with_a_reason(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(1, "medium")
    until_subtask(env, 2)
    other = env.layout.hidden[1]
    snapshot = play(env, Motions(env.physics).pick_container(f"container_{other.container}"))
    assert snapshot.status is Status.FAIL
    asked = env.layout.hidden[0].color
    assert snapshot.reason == (
        f"lifted container_{other.container}, which hides the {other.color} cube, not the {asked} cube"
    )


def test_before_both_buttons_nothing_that_is_lifted_counts(
    env: Environment, until_subtask: Until, hoist: Hoist
) -> None:
    env.reset(1, "medium")
    until_subtask(env, 1)
    assert hoist(env, "container_0").status is Status.ONGOING


def test_two_picks_while_putting_down_another_one_must_stay_where_it_is(
    env: Environment, until_subtask: Until, hoist: Hoist
) -> None:
    env.reset(2, "hard")
    other = env.layout.hidden[1].container
    until_subtask(env, 3)
    assert hoist(env, f"container_{other}").status is Status.FAIL


def test_two_picks_the_first_is_not_the_second(env: Environment, until_subtask: Until, hoist: Hoist) -> None:
    env.reset(2, "hard")
    first = env.layout.hidden[0].container
    until_subtask(env, 4)
    assert hoist(env, f"container_{first}").status is Status.FAIL


def test_the_list_and_the_instruction(env: Environment) -> None:
    env.reset(1, "medium")
    color = env.layout.hidden[0].color
    assert [(subtask.text, subtask.grounds[0]) for subtask in env.subtasks] == [
        ("press the first button[ at <>]", "button_right/cap"),
        ("press the second button[ at <>]", "button_left/cap"),
        (
            f"pick up the container[ at <>] that hides the {color} cube",
            f"container_{env.layout.hidden[0].container}",
        ),
    ]
    assert env.instruction == (
        f"first press both buttons on the table, then pick up the container hiding the {color} cube"
    )


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(snapshot.step)
    for difficulty, upstream_mean in {"easy": 407, "medium": 318, "hard": 466}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.12)
