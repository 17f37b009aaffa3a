"""VideoPlaceButton: before or after the button, targets that change places, and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.geometry import Footprint, distance_m, is_clear, pose
from dual_system.tasks.oracle import Motions
from dual_system.tasks.placing import BUTTON_ROOM_HALF_M
from dual_system.tasks.reference.video_place import Layout
from dual_system.tasks.reference.video_place_button import VideoPlaceButton
from dual_system.tasks.scene import FRONT

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]

NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
NUM_TARGETS = {"easy": 3, "medium": 4, "hard": 4}


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("VideoPlaceButton")


@cache
def sampled(seed: int, difficulty: str) -> Layout:
    return VideoPlaceButton().sample(np.random.default_rng(seed), difficulty)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [sampled(seed, difficulty) for seed in range(60)]
    assert {len(layout.cubes) for layout in layouts} == {NUM_CUBES[difficulty]}
    assert {len(layout.targets_xy_m) for layout in layouts} == {NUM_TARGETS[difficulty]}
    assert {len(layout.swaps) for layout in layouts} == {1 if difficulty == "hard" else 0}
    assert {layout.asked for layout in layouts} == {0, 1}
    assert {layout.color for layout in layouts} == {"red", "blue", "green"}
    for layout in layouts:
        assert (layout.visits, layout.num_before_press) == ((0, 1), 1)
        assert len({cube.color for cube in layout.cubes}) == len(layout.cubes)
        assert np.all(np.abs(np.subtract(layout.button_xy_m, (0.1, 0.0))) <= (0.025, 0.15))
        assert np.all(np.abs(np.subtract(layout.parking_xy_m, (-0.1, 0.0))) <= 0.04)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_things_keep_their_distance(difficulty: str) -> None:
    for seed in range(60):
        layout = sampled(seed, difficulty)
        solid = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_ROOM_HALF_M)]
        for cube in layout.cubes:
            assert all(is_clear(cube.footprint, other, 0.02) for other in solid)
            solid.append(cube.footprint)
        aside = [*((target_m, 0.04) for target_m in layout.targets_xy_m), (layout.parking_xy_m, 0.06)]
        for nth, target_m in enumerate(layout.targets_xy_m):
            assert np.abs(target_m).max() <= 0.16
            assert all(distance_m(target_m, footprint) >= 0.06 for footprint in solid)
            for other_m, radius_m in aside[nth + 1 :]:
                assert np.hypot(*np.subtract(target_m, other_m)) >= 0.06 + radius_m
        others = [cube for index, cube in enumerate(layout.cubes) if index != layout.carried]
        assert all(distance_m(layout.parking_xy_m, cube.footprint) >= 0.05 for cube in others)


def test_the_video_shows_placing_button_placing_and_putting_aside(env: Environment) -> None:
    env.reset(1, "medium")
    texts = [frame.simple_subgoal for frame in env.demonstration()]
    changes = [text for text, before in zip(texts, ["", *texts], strict=False) if text != before]
    assert changes == [
        "pick up the cube",
        "drop the cube onto target",
        "press the button",
        "pick up the cube",
        "drop the cube onto target",
        "pick up the cube",
        "drop the cube onto table",
        "static",
    ]


def test_the_cube_waits_aside_and_nothing_else_has_moved(env: Environment) -> None:
    env.reset(1, "medium")
    layout = env.layout
    for index, cube in enumerate(layout.cubes):
        there_m = layout.parking_xy_m if index == layout.carried else (cube.x_m, cube.y_m)
        np.testing.assert_allclose(env.physics.position_m(f"cube_{index}")[:2], there_m, atol=0.01)
    for index, target_m in enumerate(layout.targets_xy_m):
        np.testing.assert_array_equal(env.physics.position_m(f"target_{index}"), [*target_m, 0.005])


def test_hard_two_targets_have_changed_places_when_the_video_ends(env: Environment) -> None:
    env.reset(2, "hard")
    layout = env.layout
    ((first, second),) = layout.swaps
    now = list(range(len(layout.targets_xy_m)))
    now[first], now[second] = now[second], now[first]
    for index, place in enumerate(now):
        at_m = env.physics.position_m(f"target_{index}")
        np.testing.assert_allclose(at_m, [*layout.targets_xy_m[place], 0.005], atol=1e-9)


def test_hard_targets_bulge_by_a_tenth_of_a_metre_on_their_way(env: Environment) -> None:
    env.reset(2, "hard")
    ((first, _),) = env.layout.swaps
    now = env.save()
    way_m = []
    for row in now.video:
        env.physics.load(row.physics)
        way_m.append(env.physics.position_m(f"target_{first}")[:2])
    env.restore(now)
    chord = way_m[-1] - way_m[0]
    aside_m = np.subtract(way_m, way_m[0]) @ np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
    assert np.abs(aside_m).max() == pytest.approx(0.1, abs=1e-3)


def test_another_cube_fails_with_a_reason(env: Environment, play: Play) -> None:
    env.reset(1, "medium")
    layout = env.layout
    wrong = (layout.carried + 1) % 3
    snapshot = play(env, Motions(env.physics).pick(f"cube_{wrong}"))
    assert snapshot.status is Status.FAIL
    other = layout.cubes[wrong].color
    assert snapshot.reason == f"picked up cube_{wrong}, a {other} cube, not the {layout.color} one"


def test_every_other_target_fails_with_a_reason(env: Environment, until_subtask: Until) -> None:
    env.reset(1, "medium")
    layout = env.layout
    until_subtask(env, 1)
    lifted = env.save()
    for index in set(range(4)) - {layout.answer}:
        env.restore(lifted)
        snapshot = laid_on(env, f"target_{index}")
        assert snapshot.status is Status.FAIL
        assert snapshot.reason == f"placed the cube onto target_{index}, not onto target_{layout.answer}"
    env.restore(lifted)
    assert laid_on(env, f"target_{layout.answer}").status is Status.SUCCESS


def laid_on(env: Environment, target: str) -> Snapshot:
    """One step after which the cube lies on a target, as if somebody had put it there."""
    x_m, y_m, _ = env.physics.position_m(target)
    env.physics.place(f"cube_{env.layout.carried}", pose(x_m, y_m, 0.02))
    env.physics.refresh()
    return env.step(env.physics.command())


def test_beside_all_targets_is_no_end(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(1, "medium")
    until_subtask(env, 1)
    assert play(env, Motions(env.physics).place_at(*env.layout.parking_xy_m, 0.01)).status is Status.ONGOING


def test_hard_who_goes_by_the_place_and_not_by_the_target_loses(
    env: Environment, play: Play, until_subtask: Until
) -> None:
    seed = next(seed for seed in range(50) if sampled(seed, "hard").answer in sampled(seed, "hard").swaps[0])
    env.reset(seed, "hard")
    layout = env.layout
    until_subtask(env, 1)
    motions = Motions(env.physics)
    assert play(env, motions.place_at(*layout.targets_xy_m[layout.answer], 0.005)).status is Status.FAIL


@pytest.mark.parametrize(("asked", "relation"), [(0, "before"), (1, "after")])
def test_the_list_and_the_instruction(asked: int, relation: str) -> None:
    layout = replace(sampled(0, "medium"), asked=asked)
    subtasks = VideoPlaceButton().subtasks(layout)
    assert [subtask.text for subtask in subtasks] == [
        "pick up the cube[ at <>]",
        "place the cube onto the correct target[ at <>]",
    ]
    assert subtasks[1].grounds == (f"target_{asked}",)
    assert VideoPlaceButton().instruction(layout) == (
        f"watch the video carefully, then place the {layout.color} cube "
        f"on the target right {relation} the button was pressed"
    )


def test_what_must_be_kept_in_mind() -> None:
    layout = replace(sampled(0, "hard"), asked=1, swaps=((1, 3),))
    layout = replace(layout, targets_xy_m=((0.1, 0.1), (0.1, -0.1), (0.0, 0.0), (0.1, 0.15)))
    begin = (
        f"Demo selected the order C, button, A for the {layout.color} cube; "
        "after tracking A, the target right after the button was pressed, through swaps A <-> D, choose "
    )
    assert [VideoPlaceButton().reasoning(layout, index).text for index in (0, 1)] == [
        begin + f"the {layout.color} cube[ at <>] for target A[ at <>].",
        begin + "target A[ at <>].",
    ]


@pytest.mark.sim
def test_only_the_video_tells_before_from_after() -> None:
    """The point of the task: what is seen now does not say which target was which, what was seen does."""

    def seen(layout: Layout) -> tuple[list[np.ndarray], np.ndarray]:
        first = env.reset(1, "easy", layout=layout)
        return [frame.frames[FRONT] for frame in env.demonstration(1)], first.frames[FRONT]

    layout = sampled(1, "easy")
    one, two, *others = layout.targets_xy_m
    with make_environment("VideoPlaceButton", image_px=128) as env:
        video, now = seen(layout)
        other_video, other_now = seen(replace(layout, targets_xy_m=(two, one, *others)))
    assert any(np.any(frame != other) for frame, other in zip(video, other_video, strict=False))
    assert np.abs(now.astype(int) - other_now).mean() < 0.5  # but for the millimetre by which the cube lies elsewhere


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
    for difficulty, upstream_mean in {"easy": 966, "medium": 963, "hard": 966}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.1)
