"""VideoUnmaskSwap: who swaps with whom, that it is the container that counts and not the place, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from dual_system.tasks import swaps
from dual_system.tasks.containers import HIDING_Z_M
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Spot
from dual_system.tasks.oracle import Motions
from dual_system.tasks.permanence.scenes import LANE_M, Layout
from dual_system.tasks.permanence.video_unmask_swap import VideoUnmaskSwap

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]
Hoist = Callable[[Environment, str], Snapshot]

NUM_CONTAINERS = {"easy": 3, "medium": 4, "hard": 4}
NUM_SWAPS = {"easy": {1, 2}, "medium": {1, 2}, "hard": {2, 3}}
NUM_PICKS = {"easy": {1, 2}, "medium": {1}, "hard": {2}}


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("VideoUnmaskSwap")


def final_spots(layout: Layout) -> tuple[Spot, ...]:
    return swaps.spots_after(layout.containers, layout.swaps, 1000, LANE_M)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [VideoUnmaskSwap().sample(np.random.default_rng(seed), difficulty) for seed in range(60)]
    assert {len(layout.containers) for layout in layouts} == {NUM_CONTAINERS[difficulty]}
    assert {len(layout.swaps) for layout in layouts} == NUM_SWAPS[difficulty]
    assert {layout.num_picks for layout in layouts} == NUM_PICKS[difficulty]
    assert {layout.hidden[0].container for layout in layouts} == {0, 1, 2}
    for layout in layouts:
        assert {cube.container for cube in layout.hidden} == {0, 1, 2}
        movers = [first for first, _ in layout.swaps]
        assert len(set(movers)) == len(movers)
        assert set(movers[:2]) <= {0, 1, 2}
        for nth, (mover, partner) in enumerate(layout.swaps):
            now = swaps.spots_after(layout.containers, layout.swaps[:nth], 1000, LANE_M)
            assert partner == swaps.nearest(now, mover)


@pytest.mark.parametrize(("num_swaps", "num_frames"), [(1, 114), (2, 168), (3, 216)])
def test_the_video_ends_when_the_last_swap_has(env: Environment, num_swaps: int, num_frames: int) -> None:
    seed = next(seed for seed in range(50) if len(layout_of(seed).swaps) == num_swaps)
    env.reset(seed)
    assert len(env.save().video) == num_frames


def layout_of(seed: int) -> Layout:
    return VideoUnmaskSwap().sample(np.random.default_rng(seed), DIFFICULTIES[seed % 3])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_cube_is_back_under_its_own_container(env: Environment, seed: int) -> None:
    env.reset(seed)
    spots = final_spots(env.layout)
    for cube in env.layout.hidden:
        container_m = env.physics.position_m(f"container_{cube.container}")
        np.testing.assert_allclose(container_m, [*spots[cube.container].xy_m, HIDING_Z_M], atol=5e-4)
        np.testing.assert_allclose(env.physics.position_m(f"cube_{cube.container}")[:2], container_m[:2], atol=5e-4)


def test_who_goes_by_the_place_and_not_by_the_container_loses(env: Environment, play: Play) -> None:
    seed = next(seed for seed in range(90) if places_deceive(layout_of(seed)))
    env.reset(seed)
    asked = env.layout.hidden[0].container
    old_m = env.layout.containers[asked].xy_m
    spots = final_spots(env.layout)
    there = min(range(len(spots)), key=lambda i: float(np.hypot(*np.subtract(spots[i].xy_m, old_m))))
    snapshot = play(env, Motions(env.physics).pick_container(f"container_{there}"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason.startswith(f"lifted container_{there}, which hides ")


def places_deceive(layout: Layout) -> bool:
    """True if the container asked for first is not where it was first seen."""
    asked = layout.hidden[0].container
    moved_m = np.subtract(final_spots(layout)[asked].xy_m, layout.containers[asked].xy_m)
    return bool(np.hypot(*moved_m) > 0.05)


def test_two_picks_while_putting_down_another_one_must_stay_where_it_is(
    env: Environment, until_subtask: Until, hoist: Hoist
) -> None:
    env.reset(2, "hard")
    other = env.layout.hidden[1].container
    until_subtask(env, 1)
    assert hoist(env, f"container_{other}").status is Status.FAIL


def test_two_picks_the_first_is_not_the_second(env: Environment, until_subtask: Until, hoist: Hoist) -> None:
    env.reset(2, "hard")
    first = env.layout.hidden[0].container
    until_subtask(env, 2)
    assert hoist(env, f"container_{first}").status is Status.FAIL


def test_the_list_and_the_instruction(env: Environment) -> None:
    env.reset(2, "hard")
    first, second = (cube.color for cube in env.layout.hidden[:2])
    assert [subtask.text for subtask in env.subtasks] == [
        f"pick up the container[ at <>] that hides the {first} cube",
        "put down the container",
        f"pick up the container[ at <>] that hides the {second} cube",
    ]
    assert env.instruction == (
        f"watch the video carefully, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    )


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        num_frames = len(env.save().video)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(num_frames + snapshot.step)
    for difficulty, upstream_mean in {"easy": 343, "medium": 251, "hard": 456}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.12)
