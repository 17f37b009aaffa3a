"""Laws of changing places: it begins and ends at the spots themselves, and nothing gets lost in between."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from dual_system.tasks.environment import make_environment
from dual_system.tasks.geometry import Spot
from dual_system.tasks.physics import Physics
from dual_system.tasks.scene import FRONT
from dual_system.tasks.sight import extrinsic, intrinsic, project
from dual_system.tasks.swaps import SWAP_STEPS, Swap, nearest, spots_after

SPOTS = (
    Spot(x_m=0.0, y_m=0.0, yaw_rad=0.1),
    Spot(x_m=0.1, y_m=0.0, yaw_rad=1.3),
    Spot(x_m=0.0, y_m=0.3, yaw_rad=6.2),
)


def assert_same(ours: Spot, theirs: Spot) -> None:
    np.testing.assert_allclose(ours.xy_m, theirs.xy_m, atol=1e-12)
    assert np.cos(ours.yaw_rad - theirs.yaw_rad) == pytest.approx(1.0)


@pytest.mark.parametrize("elapsed_steps", [-20, 0])
def test_nothing_moves_before_the_first_swap(elapsed_steps: int) -> None:
    for ours, theirs in zip(spots_after(SPOTS, [(0, 1)], elapsed_steps, 0.07), SPOTS, strict=True):
        assert_same(ours, theirs)


@pytest.mark.parametrize("late_steps", [0, 1, 1000])
def test_afterwards_the_two_have_changed_places_and_turns(late_steps: int) -> None:
    a, b, c = spots_after(SPOTS, [(0, 2)], SWAP_STEPS + late_steps, 0.07)
    for ours, theirs in ((a, SPOTS[2]), (b, SPOTS[1]), (c, SPOTS[0])):
        assert_same(ours, theirs)


def test_swaps_follow_one_another() -> None:
    swaps = [(0, 1), (1, 2), (0, 2)]
    order = [0, 1, 2]
    for done, (first, second) in enumerate(swaps, start=1):
        order[first], order[second] = order[second], order[first]
        for ours, spot in zip(spots_after(SPOTS, swaps, done * SWAP_STEPS, 0.07), order, strict=True):
            assert_same(ours, SPOTS[spot])


def test_half_way_they_pass_each_other_a_lane_to_either_side() -> None:
    a, b, _ = spots_after(SPOTS, [(0, 1)], SWAP_STEPS / 2, 0.07)
    np.testing.assert_allclose(a.xy_m, (0.05, 0.07), atol=1e-12)
    np.testing.assert_allclose(b.xy_m, (0.05, -0.07), atol=1e-12)


def test_it_turns_the_short_way_round() -> None:
    a, _, c = spots_after(SPOTS, [(0, 2)], SWAP_STEPS / 2, 0.07)
    middle_rad = (0.1 + 6.2 - 2 * np.pi) / 2
    assert np.cos(a.yaw_rad - middle_rad) == pytest.approx(1.0)
    assert np.cos(c.yaw_rad - middle_rad) == pytest.approx(1.0)


def test_the_nearest_is_another_one() -> None:
    assert [nearest(SPOTS, index) for index in range(3)] == [1, 0, 0]


def _is_followed(
    physics: Physics, spots: Sequence[Spot], pairs: Sequence[Swap], index: int, every_steps: int, phase_steps: int
) -> bool:
    """Whether the object nearest, in the picture, to where it was in the frame before is always the object itself."""
    K, Rt = intrinsic(physics, FRONT, 256), extrinsic(physics, FRONT)
    looks = range(phase_steps - every_steps, SWAP_STEPS * len(pairs) + every_steps, every_steps)
    there_m = [[(*spot.xy_m, 0.03) for spot in spots_after(spots, pairs, step, 0.07)] for step in looks]
    pixels_LK2 = np.array([project(K, Rt, np.array(each_m)) for each_m in there_m])
    moves_LK = np.linalg.norm(pixels_LK2[1:] - pixels_LK2[:-1, index, None], axis=-1)
    return bool((moves_LK.argmin(axis=-1) == index).all())


def test_frames_at_2_hz_follow_a_swap_by_nearness_and_frames_at_1_hz_do_not() -> None:
    environment = make_environment("VideoRepick", render=False)
    task, physics = environment.task, environment.physics
    followed: dict[int, list[bool]] = {1: [], 2: []}
    for seed, phase in product(range(40), range(0, 20, 4)):
        layout = task.sample(np.random.default_rng(seed), "medium")
        spots = [Spot(x_m=cube.x_m, y_m=cube.y_m, yaw_rad=cube.yaw_rad) for cube in layout.cubes]
        for look_hz, found in followed.items():
            found.append(
                _is_followed(physics, spots, layout.swaps, layout.asked, 20 // look_hz, phase % (20 // look_hz))
            )
    assert np.mean(followed[2]) > 0.95
    assert np.mean(followed[1]) < 0.6
