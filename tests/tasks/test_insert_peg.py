"""InsertPeg: what is drawn, that pegs return, that a peg fits its hole, and every way to lose."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from dual_system.tasks import panda, predicates
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Spot, is_clear
from dual_system.tasks.imitation.insert_peg import ENDS, LIT_STEPS, SIDES, InsertPeg, Layout
from dual_system.tasks.oracle import Motions
from dual_system.tasks.pegs import peg_footprint
from dual_system.tasks.props import RED

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]
PLACE = re.compile(r"<(\d+), (\d+)>")
HOME = np.append(panda.HOME_QPOS, 1.0)
LAYOUT = Layout(
    box=Spot(x_m=0.0, y_m=0.02, yaw_rad=1.5),
    pegs=(
        Spot(x_m=-0.15, y_m=-0.12, yaw_rad=0.4),
        Spot(x_m=-0.15, y_m=0.15, yaw_rad=-0.3),
        Spot(x_m=0.0, y_m=-0.25, yaw_rad=0.0),
    ),
    head_linear=(0.9, 0.2, 0.4),
    grasped="head",
    side="left",
)


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("InsertPeg")


def start(env: Environment, **changes: str) -> Snapshot:
    return env.reset(0, layout=replace(LAYOUT, **changes))


def test_sampled_scenes_obey_the_rules() -> None:
    layouts = [InsertPeg().sample(np.random.default_rng(seed), "easy") for seed in range(100)]
    for layout in layouts:
        assert np.abs(layout.box.xy_m).max() <= 0.1
        assert abs(layout.box.yaw_rad - np.pi / 2) <= np.deg2rad(20)
        covers = [peg_footprint(peg, 0.05) for peg in layout.pegs]
        for index, peg in enumerate(layout.pegs):
            assert abs(peg.x_m) <= 0.2
            assert abs(peg.y_m) <= 0.3
            assert abs(peg.yaw_rad) <= np.pi / 4
            assert np.hypot(*np.subtract(peg.xy_m, layout.box.xy_m)) > 0.06
            for other, cover in zip(layout.pegs[:index], covers, strict=False):
                assert np.hypot(*np.subtract(peg.xy_m, other.xy_m)) > 0.075
                assert is_clear(covers[index], cover, 0.0)
    assert {(layout.grasped, layout.side) for layout in layouts} == set(product(ENDS, SIDES))


def test_a_peg_weighs_what_upstreams_weighs_and_lies_in_the_hole_with_7_mm_to_spare(env: Environment) -> None:
    start(env)
    physics = env.physics
    assert physics.model.body_subtreemass[physics.model.body("peg_1").id] == pytest.approx(0.0432)
    physics.place("peg_1", Spot(x_m=0.0, y_m=0.02, yaw_rad=1.5).pose(0.04))
    physics.refresh()
    touching = physics.data.contact.geom[: physics.data.ncon]
    assert not np.isin(physics.model.geom_bodyid[touching], physics.model.body("box").id).any()
    for _ in range(20):
        physics.advance(HOME)
    assert physics.position_m("peg_1")[2] == pytest.approx(0.04 - 0.007, abs=5e-4)


def test_the_video_shows_it_and_the_pegs_return(env: Environment) -> None:
    start(env)
    first = env.save()
    for index, peg in enumerate(LAYOUT.pegs):
        np.testing.assert_allclose(env.physics.pose(f"peg_{index}"), peg.pose(0.01), atol=1e-4)
    env.physics.load(first.video[-1].physics)
    assert predicates.is_inserted(env.physics, "peg_0/tail", "peg_0/head", "box")
    env.restore(first)


def test_the_lamp_lights_up_when_the_peg_is_in_and_goes_out_again(env: Environment) -> None:
    start(env)
    lamp = env.physics.model.geom("box/core").id
    is_in, is_lit = [], []
    first = env.save()
    for row in first.video:
        env.physics.load(row.physics)
        is_in.append(predicates.is_inserted(env.physics, "peg_0/tail", "peg_0/head", "box"))
        is_lit.append(bool(np.all(row.physics.geom_rgba[lamp] == RED)))
    env.restore(first)
    assert is_in[-1]
    assert is_lit.index(True) == is_in.index(True) + 1
    task, memory = InsertPeg(), None
    env.physics.load(first.video[-1].physics)
    memory = task.remember(memory, env.physics, LAYOUT)
    env.restore(first)  # the peg is out again
    for step in range(LIT_STEPS + 3):
        task.stage(env.physics, LAYOUT, memory, step)
        assert bool(np.all(env.physics.model.geom_rgba[lamp] == np.float32(RED))) == (step <= LIT_STEPS)
        memory = task.remember(memory, env.physics, LAYOUT)


@pytest.mark.parametrize(("grasped", "side"), list(product(ENDS, SIDES)))
def test_every_end_goes_in_from_every_side(env: Environment, play: Play, grasped: str, side: str) -> None:
    start(env, grasped=grasped, side=side)
    assert [subtask.text for subtask in env.subtasks] == [
        f"Pick up the peg by grasping the {ENDS[grasped]} end[ at <>]",
        f"Insert the peg from the {side} side[ at <>]",
    ]
    assert play(env, env.oracle()).status is Status.SUCCESS
    hand_y_m = env.physics.tcp_transform()[1, 3]
    assert (hand_y_m > env.physics.position_m("box")[1]) == (side == "left")


def test_the_head_is_the_far_end() -> None:
    for seed in range(50):
        layout = InsertPeg().sample(np.random.default_rng(seed), "easy")
        for peg in layout.pegs:
            assert np.cos(peg.yaw_rad) > 0  # the head is farther along x, and x points away from the robot


@pytest.mark.parametrize(
    ("grasped", "wrong", "reason"),
    [
        ("head", "peg_0/tail", "lifted the peg by its near end; the video shows the other one"),
        ("tail", "peg_0/head", "lifted the peg by its far end; the video shows the other one"),
        ("head", "peg_1/head", "picked up peg_1; the video shows another peg"),
        ("tail", "peg_2/tail", "picked up peg_2; the video shows another peg"),
    ],
)
def test_another_grasp_fails_with_a_reason(env: Environment, play: Play, grasped: str, wrong: str, reason: str) -> None:
    start(env, grasped=grasped)
    snapshot = play(env, Motions(env.physics).pick_bar(wrong))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, reason)


def test_the_other_side_fails(env: Environment, play: Play, until_subtask: Until) -> None:
    start(env)
    until_subtask(env, 1)
    motions = Motions(env.physics)
    snapshot = play(env, motions.carry(LAYOUT.held_end, replace(LAYOUT, side="right").approach()))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == "inserted the peg from the right side; the video shows the other one"


def test_the_other_end_in_the_box_fails(env: Environment, until_subtask: Until) -> None:
    start(env)
    until_subtask(env, 1)
    along = LAYOUT.outward
    # Its centre on the side of the hand's, its tail outermost: the head, 25 mm farther in, is at the box's centre.
    x_m, y_m = np.array(LAYOUT.box.xy_m) + 0.025 * along[:2]
    yaw_rad = float(np.arctan2(-along[1], -along[0]))
    env.physics.place("peg_0", Spot(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad).pose(0.04))
    env.physics.refresh()
    snapshot = env.step(HOME)
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == "inserted the end that the video shows between the fingers"


def test_another_peg_fails_while_inserting_too(env: Environment, play: Play, until_subtask: Until) -> None:
    start(env)
    until_subtask(env, 1)
    motions = Motions(env.physics)
    play(env, motions.put_down(0.02))
    snapshot = play(env, motions.pick_bar("peg_1/tail"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "picked up peg_1; the video shows another peg")


def test_the_past_in_words(env: Environment) -> None:
    start(env, grasped="tail", side="right")
    said = env.reasoning()
    assert said.startswith("Demo sequence: the peg at <")
    assert "; modes: grasp the near end, insert from the right side. Reproduce exactly; next is: Pick up the" in said


@pytest.mark.acceptance
def test_the_oracle_solves_95_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps = []
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps.append(len(env.save().video) + snapshot.step)
    assert len(steps) >= 95
    assert np.mean(steps) == pytest.approx(477, rel=0.12)


@pytest.mark.parametrize("strays_by", [1, -1])
@pytest.mark.parametrize(("grasped", "side"), list(product(ENDS, SIDES)))
def test_who_goes_astray_is_in_front_of_the_hole_before_going_in(grasped: str, side: str, strays_by: int) -> None:
    layout = replace(LAYOUT, grasped=grasped, side=side)
    straight, straying = layout.approach(), layout.approach(strays_by)
    beside, in_front = straying[3:5]
    for pose, wanted in zip([*straying[:3], straying[-1]], straight, strict=True):
        np.testing.assert_array_equal(pose, wanted)
    aside_m = beside[:3, 3] - in_front[:3, 3]
    assert np.linalg.norm(aside_m) == pytest.approx(0.015)
    assert aside_m @ layout.outward == pytest.approx(0.0, abs=1e-9)
    assert np.cross(in_front[:3, 3] - straight[-1][:3, 3], layout.outward) == pytest.approx(0.0, abs=1e-9)
