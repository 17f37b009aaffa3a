"""StopCube: how the cube runs, what stops it, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.counting.stop_cube import Layout, StopCube
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import Motions

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
HOME = np.append(panda.HOME_QPOS, 1.0)


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("StopCube")


def start(env: Environment, *, pass_steps: int, visit: int) -> Layout:
    env.reset(4, "medium")
    layout: Layout = replace(env.layout, pass_steps=pass_steps, visit=visit)
    env.reset(4, "medium", layout=layout)
    return layout


def press_at(env: Environment, elapsed_steps: int) -> Iterable[np.ndarray]:
    """Goes above the button, waits, and presses."""
    motions = Motions(env.physics)
    return chain(motions.hover("button"), motions.wait_until(elapsed_steps), motions.push_down("button"))


def test_sampled_scenes_obey_the_rules() -> None:
    layouts = [StopCube().sample(np.random.default_rng(seed), "easy") for seed in range(200)]
    for layout in layouts:
        assert np.abs(layout.target_xy_m).max() <= 0.1
        assert abs(layout.heading_rad) <= np.deg2rad(30)
    assert {layout.pass_steps for layout in layouts} == {60, 80, 120}
    assert {layout.visit for layout in layouts} == {2, 3, 4, 5}


def test_difficulty_changes_nothing(env: Environment) -> None:
    layouts = []
    for difficulty in ("easy", "medium", "hard"):
        env.reset(3, difficulty)
        layouts.append(env.layout)
    assert layouts[0] == layouts[1] == layouts[2]


def test_the_cube_crosses_the_target_once_per_pass_and_rests_after_the_fifth(env: Environment) -> None:
    layout = start(env, pass_steps=60, visit=5)
    target_m = np.array(layout.target_xy_m)
    for visit in range(5):
        np.testing.assert_allclose(layout.cube_pose(60 * visit + 30)[:2], target_m, atol=1e-9)
    start_m, end_m = layout.cube_pose(0)[:2], layout.cube_pose(60)[:2]
    np.testing.assert_allclose((start_m + end_m) / 2, target_m, atol=1e-9)
    assert np.linalg.norm(end_m - start_m) == pytest.approx(0.6)
    assert end_m[1] > start_m[1]
    np.testing.assert_allclose(layout.cube_pose(301), layout.cube_pose(300))
    np.testing.assert_allclose(layout.cube_pose(300)[:2], end_m)


def test_the_cube_is_where_its_clock_says_whatever_the_arm_does(env: Environment, play: Play) -> None:
    layout = start(env, pass_steps=80, visit=5)
    for step in range(0, 240, 8):
        np.testing.assert_allclose(env.physics.pose("shuttle"), layout.cube_pose(step + 1), atol=1e-12)
        play(env, [HOME] * 8)


def test_the_press_is_asked_for_in_the_observation_in_which_it_is_due(env: Environment) -> None:
    layout = start(env, pass_steps=60, visit=3)
    asked_at = 0
    for step, action in enumerate(press_at(env, layout.press_step), start=1):  # reset has given an observation, too
        if env.step(action, look=False).grounded_subgoal.startswith("press"):
            asked_at = step
            break
    assert asked_at == layout.press_step


def test_checkpoints_come_every_100_steps_until_the_press(env: Environment) -> None:
    for pass_steps, visit, num_checkpoints in ((60, 2, 1), (60, 4, 2), (80, 5, 4), (120, 5, 6)):
        start(env, pass_steps=pass_steps, visit=visit)
        texts = [subtask.text for subtask in env.subtasks]
        assert texts == [
            "move to the top of the button[ at <>] to prepare",
            *["remain static"] * num_checkpoints,
            "press the button to stop the cube on the target[ at <>]",
        ]


def test_the_sentence_names_the_visit(env: Environment) -> None:
    start(env, pass_steps=60, visit=3)
    assert env.instruction == "press the button to stop the cube just as it reaches the target for the third time"


def test_a_press_stops_the_cube_for_good(env: Environment, play: Play) -> None:
    layout = start(env, pass_steps=120, visit=2)
    snapshot = play(env, env.oracle())
    assert snapshot.status is Status.SUCCESS
    stopped_step = env.save().memory.stopped_step
    assert stopped_step == snapshot.step  # success comes one step after the press
    np.testing.assert_allclose(env.physics.pose("shuttle"), layout.cube_pose(stopped_step), atol=1e-12)


def test_a_press_away_from_the_target_fails(env: Environment, play: Play) -> None:
    layout = start(env, pass_steps=120, visit=2)
    snapshot = play(env, press_at(env, layout.press_step - 30))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "stopped the cube away from the target")


def test_a_press_on_another_visit_fails(env: Environment, play: Play) -> None:
    layout = start(env, pass_steps=120, visit=3)
    snapshot = play(env, press_at(env, layout.press_step - layout.pass_steps))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "stopped the cube on visit 2 instead of 3")


def test_letting_the_visit_go_by_fails_as_soon_as_its_pass_is_over(env: Environment, play: Play) -> None:
    start(env, pass_steps=60, visit=2)
    snapshot = play(env, [HOME] * 300)
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "visit 2 went by and the cube was not stopped")
    assert snapshot.step + 1 == 60 * 2 + 1  # one more control step has passed than observations


@pytest.mark.acceptance
def test_the_oracle_solves_95_of_100_seeds(env: Environment, play: Play) -> None:
    num_solved = 0
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        num_solved += snapshot.status is Status.SUCCESS
        layout = env.layout
        middle = layout.last_step - layout.pass_steps / 2
        assert snapshot.step == pytest.approx(middle, abs=8)
    assert num_solved >= 95
