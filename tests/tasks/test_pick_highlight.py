"""PickHighlight: what shines when, what wins, what loses, and two quirks kept from upstream."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Footprint, is_clear
from dual_system.tasks.oracle import Motions
from dual_system.tasks.reference.pick_highlight import Layout, PickHighlight
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS, CUBE_HALF_M

HOME = np.append(panda.HOME_QPOS, 1.0)
NUM_CUBES = {"easy": 3, "medium": 4, "hard": 6}
NUM_TARGETS = {"easy": 1, "medium": 2, "hard": 3}


def play(env: Environment, actions: Iterable[np.ndarray]) -> Snapshot:
    for action in actions:
        snapshot = env.step(action)
        if snapshot.status is not Status.ONGOING:
            break
    return snapshot


def non_target(layout: Layout) -> int:
    return next(i for i in range(len(layout.cubes)) if i not in layout.targets)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    for seed in range(100):
        layout = PickHighlight().sample(np.random.default_rng(seed), difficulty)
        assert len(layout.cubes) == NUM_CUBES[difficulty]
        assert len(set(layout.targets)) == NUM_TARGETS[difficulty]
        assert abs(layout.button_xy_m[0] + 0.2) <= 0.05
        assert abs(layout.button_xy_m[1]) <= 0.2
        taken = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_HALF_M)]
        for cube in layout.cubes:
            assert abs(cube.x_m + 0.1) <= 0.18
            assert abs(cube.y_m) <= 0.18
            assert cube.color in CUBE_COLORS
            spot = Footprint(center_m=(cube.x_m, cube.y_m), half_m=(CUBE_HALF_M,) * 2, yaw_rad=cube.yaw_rad)
            assert all(is_clear(spot, other, 0.04) for other in taken)
            taken.append(spot)


def test_every_color_and_every_place_in_the_list_can_be_a_target() -> None:
    layouts = [PickHighlight().sample(np.random.default_rng(seed), "medium") for seed in range(60)]
    assert {layout.cubes[i].color for layout in layouts for i in layout.targets} == set(CUBE_COLORS)
    assert {i for layout in layouts for i in layout.targets} == {0, 1, 2, 3}


@pytest.mark.parametrize("press", [True, False])
def test_discs_lie_under_the_targets_in_observations_10_to_100_only(pick_highlight: Environment, press: bool) -> None:
    env = pick_highlight
    snapshot = env.reset(4, "medium")
    actions = env.oracle() if press else iter([HOME] * 120)
    for action in actions:
        for nth, target in enumerate(env.layout.targets):
            disc_m, cube_m = env.physics.position_m(f"highlight_{nth}"), env.physics.position_m(f"cube_{target}")
            if 10 <= snapshot.step <= 100:
                np.testing.assert_allclose(disc_m, cube_m - [0, 0, 0.01], atol=1e-9)
            else:
                assert np.abs(disc_m).max() > 5
        if snapshot.step == 120:
            break
        snapshot = env.step(action)
    assert snapshot.step == 120


def test_unused_discs_never_show(pick_highlight: Environment) -> None:
    pick_highlight.reset(4, "easy")
    play(pick_highlight, [HOME] * 15)
    assert np.abs(pick_highlight.physics.position_m("highlight_0")).max() < 1
    for name in ("highlight_1", "highlight_2", "cube_3"):
        assert np.abs(pick_highlight.physics.position_m(name)).max() > 5


def test_a_wrong_cube_after_the_button_fails_with_a_reason(pick_highlight: Environment) -> None:
    env = pick_highlight
    env.reset(3, "medium")
    wrong = non_target(env.layout)
    motions = Motions(env.physics)
    play(env, motions.press("button"))
    snapshot = play(env, motions.pick(f"cube_{wrong}"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == (
        f"picked up cube_{wrong}, a {env.layout.cubes[wrong].color} cube that was not highlighted"
    )
    with pytest.raises(RuntimeError, match=r"ended with fail .* call reset"):
        env.step(HOME)


def test_quirk_a_wrong_cube_before_the_button_does_not_fail(pick_highlight: Environment) -> None:
    env = pick_highlight
    env.reset(3, "medium")
    snapshot = play(env, Motions(env.physics).pick(f"cube_{non_target(env.layout)}"))
    assert snapshot.status is Status.ONGOING
    assert snapshot.tcp_pose[2] > 0.1


def test_quirk_the_targets_alone_succeed_without_the_button_in_any_order(pick_highlight: Environment) -> None:
    env = pick_highlight
    env.reset(5, "medium")
    first, second = (f"cube_{i}" for i in env.layout.targets)
    motions = Motions(env.physics)
    assert play(env, motions.pick(second)).status is Status.ONGOING
    play(env, motions.put_down(0.01))
    snapshot = play(env, motions.pick(first))
    assert snapshot.status is Status.SUCCESS
    assert snapshot.subtask_index == 0
    assert snapshot.simple_subgoal == "All tasks completed"


def test_one_target_of_two_is_not_enough(pick_highlight: Environment) -> None:
    env = pick_highlight
    env.reset(5, "medium")
    motions = Motions(env.physics)
    play(env, motions.press("button"))
    assert play(env, motions.pick(f"cube_{env.layout.targets[0]}")).status is Status.ONGOING


def test_an_oracle_that_takes_over_keeps_holding_the_cube(pick_highlight: Environment) -> None:
    env = pick_highlight
    env.reset(5, "medium")
    for action in env.oracle():
        if env.step(action).subtask_index == 2:  # just lifted
            break
    assert next(env.oracle())[7] == -1.0


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_the_list_alternates_picking_and_placing(pick_highlight: Environment, difficulty: str) -> None:
    pick_highlight.reset(2, difficulty)
    layout, list_ = pick_highlight.layout, [subtask.text for subtask in pick_highlight.subtasks]
    colors = [layout.cubes[i].color for i in layout.targets]
    ordinals = ["first ", "second ", "third "] if len(colors) > 1 else [""]
    expected = ["press the button[ at <>]"]
    for nth, color in enumerate(colors):
        if nth:
            expected.append("place the cube onto the table")
        expected.append(f"pick up the {ordinals[nth]}highlighted cube[ at <>], which is {color}")
    assert list_ == expected


def test_time_runs_out(pick_highlight: Environment) -> None:
    env = Environment(PickHighlight(), image_px=64, render=False, max_steps=5)
    env.reset(0)
    snapshot = play(env, [HOME] * 9)
    assert (snapshot.step, snapshot.status, snapshot.reason) == (5, Status.TIMEOUT, "not done after 5 steps")


def test_stepping_before_reset_is_refused() -> None:
    env = Environment(PickHighlight(), image_px=64, render=False, max_steps=5)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(HOME)


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(pick_highlight: Environment) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        pick_highlight.reset(seed)
        snapshot = play(pick_highlight, pick_highlight.oracle())
        if snapshot.status is Status.SUCCESS:
            steps[pick_highlight.difficulty].append(snapshot.step)
    assert sum(map(len, steps.values())) >= 98
    for difficulty, upstream_mean in {"easy": 229, "medium": 384, "hard": 540}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.15)
