"""Drawing scenes: discs keep their distance, full tables are told, crowded ones are drawn again."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.tasks.geometry import Footprint, distance_m, smoothstep
from dual_system.tasks.placing import (
    PlacedCube,
    draw_disc,
    has_finger_room,
    is_in_reach,
    turned_at_random,
    until_it_fits,
)
from dual_system.tasks.scene import SceneFullError

BLOCK = Footprint(center_m=(0.0, 0.0), half_m=(0.1, 0.05), yaw_rad=np.pi / 2)  # 0.1 m wide along y


@pytest.mark.parametrize(
    ("point_m", "expected_m"),
    [((0.0, 0.0), 0.0), ((0.04, 0.09), 0.0), ((0.15, 0.0), 0.1), ((0.0, -0.3), 0.2), ((0.08, 0.14), 0.05)],
)
def test_distance_to_a_turned_rectangle(point_m: tuple[float, float], expected_m: float) -> None:
    assert distance_m(point_m, BLOCK) == pytest.approx(expected_m, abs=1e-12)


def test_a_disc_lies_whole_in_its_region_and_off_the_obstacles() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        x_m, y_m = draw_disc(rng, radius_m=0.04, center_m=(0.1, 0.0), half_m=(0.2, 0.3), obstacles=[BLOCK], gap_m=0.02)
        assert -0.06 <= x_m <= 0.26
        assert abs(y_m) <= 0.26
        assert distance_m((x_m, y_m), BLOCK) >= 0.06


def test_a_disc_keeps_its_gap_from_other_discs() -> None:
    rng = np.random.default_rng(0)
    others = [((0.1, 0.1), 0.06), ((-0.1, 0.0), 0.1)]
    for _ in range(200):
        xy_m = draw_disc(
            rng, radius_m=0.04, center_m=(0.0, 0.0), half_m=(0.2, 0.2), obstacles=(), discs=others, gap_m=0.02
        )
        assert all(np.hypot(*np.subtract(xy_m, center_m)) >= 0.06 + radius_m for center_m, radius_m in others)


def test_points_are_turned_about_the_origin_all_by_one_angle() -> None:
    points_m = [(0.1, 0.0), (0.0, 0.2), (0.3, 0.4)]
    turned_m = np.array(turned_at_random(np.random.default_rng(0), points_m))
    np.testing.assert_allclose(turned_m @ turned_m.T, np.array(points_m) @ np.array(points_m).T, atol=1e-12)
    assert np.abs(turned_m - points_m).max() > 0.01


@pytest.mark.parametrize(("xy_m", "expected"), [((0.17, 0.0), True), ((0.18, 0.0), False), ((0.1, 0.35), False)])
def test_reach_is_round_about_the_arms_base(xy_m: tuple[float, float], expected: bool) -> None:
    assert is_in_reach(xy_m) == expected


@pytest.mark.parametrize(
    ("neighbours_m", "expected"),
    [
        ([(0.05, 0.0)], True),  # the fingers come down along the other side
        ([(0.05, 0.0), (0.0, 0.05)], False),
        ([(0.09, 0.0), (0.0, 0.09)], True),
        ([(0.05, 0.05)], True),  # a corner's neighbour is in nobody's way
    ],
)
def test_fingers_need_one_direction_that_is_free(neighbours_m: list[tuple[float, float]], expected: bool) -> None:
    def cube(x_m: float, y_m: float) -> PlacedCube:
        return PlacedCube(x_m=x_m, y_m=y_m, yaw_rad=0.0, color="red")

    assert has_finger_room(cube(0.0, 0.0), [cube(*xy_m) for xy_m in neighbours_m]) == expected


def test_no_place_for_a_disc_is_told_with_the_numbers() -> None:
    with pytest.raises(SceneFullError, match=r"disc of radius 0.040 m after 256 tries: 1 obstacles"):
        draw_disc(
            np.random.default_rng(0),
            radius_m=0.04,
            center_m=(0.0, 0.0),
            half_m=(0.06, 0.06),
            obstacles=[BLOCK],
            gap_m=0.02,
        )


def test_a_crowded_scene_is_drawn_again() -> None:
    tries = iter([False, False, True])

    def draw() -> str:
        if not next(tries):
            raise SceneFullError("full")
        return "a scene"

    assert until_it_fits(draw) == "a scene"
    assert next(tries, None) is None


def test_smoothstep_starts_and_ends_at_rest() -> None:
    np.testing.assert_allclose([smoothstep(f) for f in (0.0, 0.5, 1.0)], [0.0, 0.5, 1.0])
    assert smoothstep(1e-4) < 1e-7
    assert 1 - smoothstep(1 - 1e-4) < 1e-7
