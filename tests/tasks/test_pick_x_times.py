"""PickXtimes: what is drawn, what counts as a round, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks.counting.pick_x_times import PickXtimes
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Footprint, distance_m, is_clear
from dual_system.tasks.oracle import Motions
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
REPEATS = {"easy": {1, 2, 3}, "medium": {1, 2, 3}, "hard": {4, 5}}


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("PickXtimes")


def start(env: Environment, *, repeats: int) -> None:
    """Three cubes, so many rounds."""
    env.reset(4, "medium")
    env.reset(4, "medium", layout=replace(env.layout, repeats=repeats))


def until(env: Environment, index: int) -> Iterator[np.ndarray]:
    """The oracle's actions until a subtask is current."""
    for action in env.oracle():
        yield action
        if env.save().progress.index == index:
            return


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [PickXtimes().sample(np.random.default_rng(seed), difficulty) for seed in range(100)]
    for layout in layouts:
        assert len({cube.color for cube in layout.cubes}) == len(layout.cubes) == NUM_CUBES[difficulty]
        taken = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_HALF_M)]
        for cube in layout.cubes:
            assert abs(cube.x_m + 0.1) <= 0.18 + 1e-9
            assert abs(cube.y_m) <= 0.18 + 1e-9
            assert all(is_clear(cube.footprint, other, 0.02) for other in taken)
            taken.append(cube.footprint)
        assert all(distance_m(layout.target_xy_m, other) >= 0.08 for other in taken)
        assert np.abs(np.subtract(layout.target_xy_m, (-0.1, 0))).max() <= 0.16
    assert {layout.repeats for layout in layouts} == REPEATS[difficulty]
    assert {layout.cubes[layout.asked].color for layout in layouts} == set(CUBE_COLORS)


def test_the_sentence_counts_only_from_two_on(env: Environment) -> None:
    start(env, repeats=1)
    assert env.instruction.endswith("cube and place it on the target, then press the button to stop")
    start(env, repeats=4)
    assert env.instruction.endswith("on the target, repeating this action four times, then press the button to stop")
    assert len(env.subtasks) == 9


def test_another_cube_fails(env: Environment, play: Play) -> None:
    start(env, repeats=1)
    wrong = next(i for i in range(3) if i != env.layout.asked)
    snapshot = play(env, Motions(env.physics).pick(f"cube_{wrong}"))
    assert snapshot.status is Status.FAIL
    color = env.layout.cubes[wrong].color
    assert snapshot.reason == f"picked up cube_{wrong}, a {color} cube that was not asked for"


def test_the_button_before_the_last_round_fails(env: Environment, play: Play) -> None:
    start(env, repeats=2)
    assert play(env, until(env, 2)).status is Status.ONGOING  # one round is done
    snapshot = play(env, Motions(env.physics).press("button"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "pressed the button before 2 rounds were done")


def test_picking_once_too_often_fails(env: Environment, play: Play) -> None:
    start(env, repeats=1)
    play(env, until(env, 2))
    motions = Motions(env.physics)
    play(env, motions.put_down(0.15))  # comes up from the target
    snapshot = play(env, motions.pick(f"cube_{env.layout.asked}"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == f"picked up cube_{env.layout.asked} when all rounds were done (1)"


def test_a_cube_put_down_elsewhere_does_not_count_but_may_be_fetched(env: Environment, play: Play) -> None:
    start(env, repeats=1)
    motions, cube = Motions(env.physics), f"cube_{env.layout.asked}"
    play(env, motions.pick(cube))
    assert play(env, motions.put_down(0.02)).subtask_index == 1
    play(env, motions.pick(cube))
    assert play(env, motions.place("target")).subtask_index == 2
    assert play(env, motions.press("button")).status is Status.SUCCESS


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps[env.difficulty].append(snapshot.step)
    assert sum(map(len, steps.values())) >= 98
    for difficulty, upstream_mean in {"easy": 461, "medium": 431, "hard": 796}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.2)
