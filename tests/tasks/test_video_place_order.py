"""VideoPlaceOrder: two to four places in some order, one of them asked for by its number, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import Motions
from dual_system.tasks.reference.video_place import Layout
from dual_system.tasks.reference.video_place_order import VideoPlaceOrder

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]

NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("VideoPlaceOrder")


@cache
def sampled(seed: int, difficulty: str) -> Layout:
    return VideoPlaceOrder().sample(np.random.default_rng(seed), difficulty)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [sampled(seed, difficulty) for seed in range(40)]
    assert {len(layout.cubes) for layout in layouts} == {NUM_CUBES[difficulty]}
    assert {len(layout.targets_xy_m) for layout in layouts} == {4}
    assert {len(layout.swaps) for layout in layouts} == {1 if difficulty == "hard" else 0}
    assert {len(layout.visits) for layout in layouts} == {2, 3, 4}
    assert {layout.asked for layout in layouts} == {0, 1, 2, 3}
    assert {layout.answer for layout in layouts} == {0, 1, 2, 3}
    assert {layout.num_before_press for layout in layouts} == {1, 2, 3, 4}
    for layout in layouts:
        assert len(set(layout.visits)) == len(layout.visits)
        assert layout.asked < len(layout.visits)
        assert layout.num_before_press <= len(layout.visits)
        np.testing.assert_allclose(layout.parking_xy_m, (-0.1, 0.0), atol=1e-9)


@pytest.mark.parametrize("num_before_press", [1, 3])
def test_the_video_visits_the_targets_in_order_and_presses_in_between(env: Environment, num_before_press: int) -> None:
    layout = replace(sampled(1, "easy"), visits=(2, 0, 3), num_before_press=num_before_press, asked=0)
    env.reset(1, "easy", layout=layout)
    now = env.save()
    course: list[str] = []
    for row in now.video:
        env.physics.load(row.physics)
        cube_m = env.physics.position_m(f"cube_{layout.carried}")
        lies_on = [
            f"target_{index}"
            for index, target_m in enumerate(layout.targets_xy_m)
            if np.hypot(*(cube_m[:2] - target_m)) < 0.02 and cube_m[2] < 0.021
        ]
        is_down = ["button"] if env.physics.travel_m("button/cap") < -0.005 else []
        for event in lies_on + is_down:
            if course[-1:] != [event] and not (event.startswith("target") and event in course):
                course.append(event)
    env.restore(now)
    expected = ["target_2", "target_0", "target_3"]
    expected.insert(num_before_press, "button")
    assert course == expected


def test_another_target_of_the_order_fails(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(1, "medium")
    layout = env.layout
    other = next(visited for visited in layout.visits if visited != layout.answer)
    until_subtask(env, 1)
    snapshot = play(env, Motions(env.physics).place(f"target_{other}"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == f"placed the cube onto target_{other}, not onto target_{layout.answer}"


def test_another_cube_fails(env: Environment, play: Play) -> None:
    env.reset(1, "medium")
    wrong = (env.layout.carried + 1) % 3
    assert play(env, Motions(env.physics).pick(f"cube_{wrong}")).status is Status.FAIL


def test_the_button_is_no_matter_in_the_execution(env: Environment, play: Play) -> None:
    env.reset(1, "medium")
    assert play(env, Motions(env.physics).press("button")).status is Status.ONGOING


@pytest.mark.parametrize(("asked", "nth"), [(0, "first"), (1, "second"), (2, "third"), (3, "fourth")])
def test_the_list_and_the_instruction(asked: int, nth: str) -> None:
    layout = replace(sampled(0, "medium"), visits=(3, 1, 0, 2), num_before_press=2, asked=asked)
    subtasks = VideoPlaceOrder().subtasks(layout)
    assert subtasks[1].grounds == (f"target_{layout.visits[asked]}",)
    assert VideoPlaceOrder().instruction(layout) == (
        f"watch the video carefully, then place the {layout.color} cube on the {nth} target it was previously placed on"
    )


def test_what_must_be_kept_in_mind() -> None:
    layout = replace(sampled(0, "medium"), visits=(3, 1), num_before_press=2, asked=0)
    layout = replace(layout, targets_xy_m=((0.1, 0.1), (0.1, -0.1), (0.0, 0.0), (0.1, 0.15)))
    begin = (
        f"Demo selected the order D, A, button for the {layout.color} cube; "
        "after tracking D, the first target it was previously placed on, through no swaps, choose "
    )
    assert [VideoPlaceOrder().reasoning(layout, index).text for index in (0, 1)] == [
        begin + f"the {layout.color} cube[ at <>] for target D[ at <>].",
        begin + "target D[ at <>].",
    ]


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        num_frames = len(env.save().video)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps[env.difficulty].append(num_frames + snapshot.step)
    assert sum(map(len, steps.values())) >= 98
    for difficulty, upstream_mean in {"easy": 1126, "medium": 1133, "hard": 1112}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.12)
