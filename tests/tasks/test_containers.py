"""Containers stand, cover, and can be gripped; their places are drawn clear of each other."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.containers import EMPTY_Z_M, HIDDEN_HALF_M, HIDING_Z_M, add_container, draw_spots
from dual_system.tasks.geometry import Footprint, Spot, is_clear, pose
from dual_system.tasks.oracle import Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.scene import add_cube, table_scene

HOME = np.append(panda.HOME_QPOS, 1.0)


@pytest.fixture(scope="module")
def _table() -> Physics:
    spec = table_scene()
    add_container(spec, "container")
    add_cube(spec, "cube", HIDDEN_HALF_M)
    return Physics(spec)


@pytest.fixture
def table(_table: Physics) -> Physics:
    _table.reset()
    return _table


def test_it_weighs_what_upstreams_does(table: Physics) -> None:
    assert table.model.body("container").mass[0] == pytest.approx(0.1311, abs=5e-5)


def test_an_empty_one_stands_still_on_the_table(table: Physics) -> None:
    table.place("container", Spot(x_m=0.1, y_m=-0.1, yaw_rad=0.4).pose(EMPTY_Z_M))
    table.refresh()
    for _ in range(40):
        table.advance(HOME)
    np.testing.assert_allclose(table.pose("container"), pose(0.1, -0.1, EMPTY_Z_M, 0.4), atol=1e-4)


@pytest.mark.parametrize("yaw_rad", np.linspace(0.0, np.pi / 2, 13))
def test_one_that_covers_a_cube_rests_on_it_whatever_its_turn(table: Physics, yaw_rad: float) -> None:
    """MuJoCo's own box-box contact would stop some of these with a fatal error."""
    table.place("cube", pose(0.1, -0.1, HIDDEN_HALF_M))
    table.place("container", Spot(x_m=0.1, y_m=-0.1, yaw_rad=yaw_rad).pose(HIDING_Z_M))
    table.refresh()
    for _ in range(40):
        table.advance(HOME)
    np.testing.assert_allclose(table.position_m("container"), [0.1, -0.1, HIDING_Z_M], atol=3e-4)
    np.testing.assert_allclose(table.position_m("cube"), [0.1, -0.1, HIDDEN_HALF_M], atol=3e-4)


def test_the_oracle_lifts_it_off_its_cube_and_puts_it_back(table: Physics) -> None:
    table.place("cube", pose(0.0, 0.1, HIDDEN_HALF_M))
    table.place("container", Spot(x_m=0.0, y_m=0.1, yaw_rad=0.3).pose(HIDING_Z_M))
    table.refresh()
    motions = Motions(table)
    for action in motions.pick_container("container"):
        table.advance(action.astype(np.float64))
    assert table.is_grasped("container")
    assert table.position_m("container")[2] > 0.17
    np.testing.assert_allclose(table.position_m("cube"), [0.0, 0.1, HIDDEN_HALF_M], atol=3e-4)
    for action in motions.put_down(0.07):
        table.advance(action.astype(np.float64))
    assert not table.is_grasped("container")
    np.testing.assert_allclose(table.position_m("container"), [0.0, 0.1, HIDING_Z_M], atol=5e-3)


def test_places_keep_their_distance_and_their_area() -> None:
    obstacle = Footprint(center_m=(0.0, 0.0), half_m=(0.03, 0.03))
    for seed in range(20):
        rng = np.random.default_rng(seed)
        spots = draw_spots(rng, [(0.0, 0.0)] * 5, half_m=0.2, obstacles=[obstacle], gap_m=0.04)
        taken = [obstacle]
        for spot in spots:
            square = Footprint(center_m=spot.xy_m, half_m=(0.0275, 0.0275), yaw_rad=spot.yaw_rad)
            assert all(is_clear(square, other, 0.04) for other in taken)
            assert max(map(abs, spot.xy_m)) <= 0.2 - 0.0275
            assert 0.0 <= spot.yaw_rad <= np.pi / 2
            taken.append(square)
        assert len(spots) == 5


def test_a_full_area_ends_the_draw() -> None:
    spots = draw_spots(np.random.default_rng(0), [(0.0, 0.0)] * 15, half_m=0.1, obstacles=[], gap_m=0.04)
    assert 1 <= len(spots) < 15
