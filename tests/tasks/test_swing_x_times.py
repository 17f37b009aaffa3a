"""SwingXtimes: what is drawn, what turns red, what counts as an arrival, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.counting.swing_x_times import SwingXtimes
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Footprint, distance_m, is_clear, pose
from dual_system.tasks.oracle import Motions
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
HOME = np.append(panda.HOME_QPOS, 1.0)
NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
REPEATS = {"easy": {1, 2, 3}, "medium": {1, 2}, "hard": {3}}


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("SwingXtimes")


def start(env: Environment, *, repeats: int) -> str:
    """Three cubes, so many rounds. Returns the name of the cube to carry."""
    env.reset(4, "medium")
    env.reset(4, "medium", layout=replace(env.layout, repeats=repeats))
    return f"cube_{env.layout.asked}"


def until(env: Environment, index: int) -> Iterator[np.ndarray]:
    """The oracle's actions until a subtask is current."""
    for action in env.oracle():
        yield action
        if env.save().progress.index == index:
            return


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [SwingXtimes().sample(np.random.default_rng(seed), difficulty) for seed in range(100)]
    for layout in layouts:
        assert len({cube.color for cube in layout.cubes}) == len(layout.cubes) == NUM_CUBES[difficulty]
        taken = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_HALF_M)]
        for cube in layout.cubes:
            assert np.abs([cube.x_m + 0.1, cube.y_m]).max() <= 0.23 + 1e-9
            assert all(is_clear(cube.footprint, other, 0.02) for other in taken)
            taken.append(cube.footprint)
        for xy_m, side in ((layout.right_xy_m, -1), (layout.left_xy_m, 1)):
            assert np.abs(np.subtract(xy_m, (-0.1, 0.2 * side))).max() <= 0.06 + 1e-9
            assert all(distance_m(xy_m, other) >= 0.06 for other in taken)
    assert {layout.repeats for layout in layouts} == REPEATS[difficulty]
    assert {layout.cubes[layout.asked].color for layout in layouts} == set(CUBE_COLORS)


def test_right_is_the_robots_right(env: Environment) -> None:
    start(env, repeats=1)
    assert env.physics.position_m("target_right")[1] < 0 < env.physics.position_m("target_left")[1]


def test_the_sentence_depends_on_the_number_of_rounds(env: Environment) -> None:
    start(env, repeats=1)
    assert env.instruction.endswith(
        "cube, move it to the top of the right-side target, then put it down on the left-side target, "
        "finally press the button to stop"
    )
    start(env, repeats=3)
    assert env.instruction.endswith(
        "cube, move it to the top of the right-side target, then move it to the top of the left-side target, "
        "repeating this back-and-forth motion three times, finally press the button to stop"
    )
    assert [subtask.text for subtask in env.subtasks[3:5]] == [
        "move to the top of the right-side target[ at <>] for the second time",
        "move to the top of the left-side target[ at <>] for the second time",
    ]


def test_a_target_turns_red_when_the_cube_comes_and_stays_so_20_steps_after_it_left(env: Environment) -> None:
    cube = start(env, repeats=2)
    place_m = env.physics.position_m("target_right")

    def is_red() -> bool:
        return bool(np.abs(env.physics.position_m("red_right")).max() < 1)

    reds = []
    for step in range(40):  # the cube is over the target in steps 5 to 9
        away_m = 0.0 if 5 <= step < 10 else 0.1
        env.physics.place(cube, pose(place_m[0] + away_m, place_m[1], 0.1))
        env.physics.refresh()
        env.step(HOME)
        reds.append(is_red())
        if reds[-1]:
            np.testing.assert_allclose(env.physics.position_m("red_right"), place_m - [0, 0, 0.01], atol=1e-9)
    # Seen at step 5, shown from step 6 on; last seen at step 9, shown until 20 steps after the next.
    assert [step for step, red in enumerate(reds) if red] == list(range(6, 31))
    assert np.abs(env.physics.position_m("red_left")).max() > 5


def test_a_trembling_hand_arrives_once(env: Environment) -> None:
    cube = start(env, repeats=2)
    x_m, y_m, _ = env.physics.position_m("target_right")
    task, memory = SwingXtimes(), None
    heights_m = (0.10, 0.125, 0.11, 0.29, 0.10)  # around and above the height of arrival, below that of leaving
    for z_m in heights_m:
        env.physics.place(cube, pose(x_m, y_m, z_m))
        env.physics.refresh()
        memory = task.remember(memory, env.physics, env.layout)
    assert memory is not None
    assert (memory.right.num_arrivals, memory.left.num_arrivals) == (1, 0)
    for offset_m, num_arrivals in ((0.039, 1), (0.041, 1), (0.035, 1), (0.029, 2)):
        env.physics.place(cube, pose(x_m + offset_m, y_m, 0.1))
        env.physics.refresh()
        memory = task.remember(memory, env.physics, env.layout)
        assert memory.right.num_arrivals == num_arrivals


def test_swinging_once_too_often_fails(env: Environment, play: Play) -> None:
    start(env, repeats=1)
    assert play(env, until(env, 3)).status is Status.ONGOING  # right and left are done
    snapshot = play(env, Motions(env.physics).swing_over("target_right"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "came over a target 3 times; 1 rounds take 2")


def test_another_cube_fails(env: Environment, play: Play) -> None:
    cube = start(env, repeats=1)
    wrong = next(i for i in range(3) if f"cube_{i}" != cube)
    snapshot = play(env, Motions(env.physics).pick(f"cube_{wrong}"))
    color = env.layout.cubes[wrong].color
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == f"picked up cube_{wrong}, a {color} cube that was not asked for"


def test_the_button_before_the_end_fails(env: Environment, play: Play) -> None:
    start(env, repeats=1)
    snapshot = play(env, Motions(env.physics).press("button"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "pressed the button before the cube was put down")


def test_the_left_target_first_does_not_advance_the_list(env: Environment, play: Play) -> None:
    cube = start(env, repeats=2)
    motions = Motions(env.physics)
    play(env, motions.pick(cube))
    assert play(env, motions.swing_over("target_left")).subtask_index == 1


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps[env.difficulty].append(snapshot.step)
    assert sum(map(len, steps.values())) >= 98
    for difficulty, upstream_mean in {"easy": 433, "medium": 380, "hard": 490}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.2)
