"""RouteStick: what routes there are, on which side of a post the tip went, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.imitation.route_stick import CLOCKWISE, COUNTERCLOCKWISE, Layout, Memory, RouteStick
from dual_system.tasks.oracle import Motions
from dual_system.tasks.scene import FRONT, WRIST

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
NUM_MOVES = {"easy": {2, 3}, "medium": {4, 5}, "hard": {4, 5, 6, 7}}
ROW = Layout(
    turn_rad=0.3,
    post_colors=((0.8, 0.2, 0.2), (0.2, 0.8, 0.2), (0.2, 0.2, 0.8), (0.8, 0.8, 0.2)),
    route=(2, 3, 2),
    sides=(CLOCKWISE, CLOCKWISE),
)
BULGE_M = {CLOCKWISE: 0.2, COUNTERCLOCKWISE: -0.2}


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("RouteStick")


def come_down_on(env: Environment, x_m: float, y_m: float, z_m: float) -> Iterator[np.ndarray]:
    """Lifts the tip above the posts, goes to a place, and comes down on it."""
    motions, tool = Motions(env.physics), env.physics.tcp_transform()
    here_m = tool[:2, 3].copy()
    for point_m in ((*here_m, 0.2), (x_m, y_m, 0.2), (x_m, y_m, z_m)):
        tool[:3, 3] = point_m
        yield from motions.move(tool)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_routes_go_from_neighbour_to_neighbour(difficulty: str) -> None:
    layouts = [RouteStick().sample(np.random.default_rng(seed), difficulty) for seed in range(200)]
    turns_back = False
    for layout in layouts:
        assert abs(layout.turn_rad) <= np.pi / 6
        assert all(abs(end - start) == 1 for start, end in pairwise(layout.route))
        assert set(layout.route) <= set(range(5))
        assert len(layout.sides) == len(layout.route) - 1
        inner = zip(layout.route, layout.route[1:], layout.route[2:], strict=False)
        turns_back |= any(before == after and here not in (0, 4) for before, here, after in inner)
    assert {len(layout.sides) for layout in layouts} == NUM_MOVES[difficulty]
    assert {side for layout in layouts for side in layout.sides} == {CLOCKWISE, COUNTERCLOCKWISE}
    assert {layout.route[0] for layout in layouts} == set(range(5))
    assert turns_back == (difficulty == "hard")


def test_the_row_has_nine_slots_seven_centimetres_apart_turned_as_a_whole() -> None:
    slots_m = np.array([ROW.xy_m(slot) for slot in range(9)])
    np.testing.assert_allclose(np.linalg.norm(np.diff(slots_m, axis=0), axis=1), 0.07)
    np.testing.assert_allclose(slots_m[4], -0.1 * np.array([np.cos(0.3), np.sin(0.3)]))
    straight = replace(ROW, turn_rad=0.0)
    np.testing.assert_allclose([straight.xy_m(slot) for slot in (0, 8)], [[-0.1, -0.28], [-0.1, 0.28]])


def test_the_list_the_instruction_and_the_reasoning(env: Environment) -> None:
    env.reset(0, layout=replace(ROW, sides=(CLOCKWISE, COUNTERCLOCKWISE)))
    assert [subtask.text for subtask in env.subtasks] == [
        "move to the nearest left target by circling around the stick clockwise",
        "move to the nearest right target by circling around the stick counterclockwise",
    ]
    assert env.instruction == (
        "watch the video carefully, then use the stick attached to the robot to navigate around the sticks on the "
        "table, following the same path"
    )
    assert env.reasoning() == (
        "Demo sequence: target_0 at <83, 120> -> target_1 at <76, 152> -> target_2 at <83, 120>; modes: clockwise, "
        "counterclockwise. Reproduce exactly; next is target_0 -> target_1, on the left, circling clockwise around "
        "the post between. Subgoal: move to the nearest left target by circling around the stick clockwise."
    )


points = st.tuples(st.floats(-0.4, 0.2), st.floats(-0.4, 0.4))


@given(points, st.integers(1, 100))
def test_the_robots_side_of_a_leftward_move_is_clockwise(xy_m: tuple[float, float], num_points: int) -> None:
    """Left of a move towards larger y is towards the robot, and clockwise; right of it is the other way round."""
    layout = replace(ROW, turn_rad=0.0)
    sum_xy_m = (xy_m[0] * num_points, xy_m[1] * num_points)
    memory = Memory(move=0, has_arrived=True, num_points=num_points, sum_xy_m=sum_xy_m, touches=())
    leaning_m2 = memory.leaning_m2(layout)
    assert leaning_m2 == pytest.approx(0.14 * (-0.1 - xy_m[0]), abs=1e-9)
    back = replace(memory, move=1)
    assert back.leaning_m2(layout) == pytest.approx(-leaning_m2, abs=1e-9)


def test_the_wrong_side_fails_on_arrival_with_a_reason(env: Environment, play: Play) -> None:
    env.reset(0, layout=ROW)
    snapshot = play(env, Motions(env.physics).sweep_to("target_6", BULGE_M[COUNTERCLOCKWISE]))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == ("came from target_4 to target_6 on the wrong side of the post; clockwise was shown")
    assert np.hypot(*np.subtract(snapshot.tcp_pose[:2], ROW.xy_m(6))) <= 0.03


@pytest.mark.parametrize(("aside_m", "status", "index"), [(-0.07, Status.ONGOING, 1), (0.07, Status.FAIL, 0)])
def test_arriving_high_counts_and_a_detour_high_above_counts_too(
    env: Environment, play: Play, aside_m: float, status: Status, index: int
) -> None:
    """A target is reached from below 15 cm on; only the side of the way matters, not its height."""
    env.reset(0, layout=ROW)
    x_m, y_m = ROW.xy_m(5)
    beside_m = (x_m + aside_m * np.cos(ROW.turn_rad), y_m + aside_m * np.sin(ROW.turn_rad))
    assert play(env, come_down_on(env, *beside_m, 0.2)).status is Status.ONGOING
    snapshot = play(env, come_down_on(env, *ROW.xy_m(6), 0.13))
    assert (snapshot.status, snapshot.subtask_index) == (status, index)


def test_touching_another_target_fails_with_a_reason(env: Environment, play: Play) -> None:
    env.reset(0, layout=ROW)
    snapshot = play(env, come_down_on(env, *ROW.xy_m(2), 0.07))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "touched target_2 on the way from target_4 to target_6")


def test_hovering_high_over_another_target_touches_nothing(env: Environment, play: Play) -> None:
    env.reset(0, layout=ROW)
    assert play(env, come_down_on(env, *ROW.xy_m(2), 0.12)).status is Status.ONGOING


def test_each_move_is_judged_by_its_own_way(env: Environment, play: Play) -> None:
    """A long stay on one side in the first move does not colour the second."""
    env.reset(0, layout=ROW)
    assert play(env, Motions(env.physics).sweep_to("target_6", BULGE_M[CLOCKWISE])).subtask_index == 1
    snapshot = play(env, Motions(env.physics).sweep_to("target_4", BULGE_M[CLOCKWISE]))
    assert snapshot.status is Status.SUCCESS
    env.reset(0, layout=ROW)
    play(env, Motions(env.physics).sweep_to("target_6", BULGE_M[CLOCKWISE]))
    snapshot = play(env, Motions(env.physics).sweep_to("target_4", BULGE_M[COUNTERCLOCKWISE]))
    assert (snapshot.status, snapshot.subtask_index) == (Status.FAIL, 1)


def test_targets_are_red_from_three_centimetres_on(env: Environment, play: Play) -> None:
    env.reset(0, layout=ROW)
    reds = {}
    for step, action in enumerate(Motions(env.physics).sweep_to("target_6", BULGE_M[CLOCKWISE])):
        snapshot = env.step(action)
        away_m = float(np.hypot(*np.subtract(snapshot.tcp_pose[:2], ROW.xy_m(6))))
        reds[step] = (away_m <= 0.03, bool(env.physics.model.geom("target_6/red/0").rgba[3] > 0))
    arrived = min(step for step, (is_near, _) in reds.items() if is_near)
    assert [is_red for _, is_red in reds.values()] == [step > arrived for step in reds]


def test_posts_stand_between_the_targets_in_their_colors(env: Environment) -> None:
    env.reset(0, layout=ROW)
    for index, slot in enumerate((1, 3, 5, 7)):
        np.testing.assert_allclose(env.physics.position_m(f"post_{slot}"), [*ROW.xy_m(slot), 0.05], atol=1e-12)
        assert int(env.physics.model.geom(f"post_{slot}").rgba[:3].argmax()) == (0, 1, 2, 0)[index]


def test_the_video_has_fifty_frames_per_move(env: Environment) -> None:
    env.reset(0, layout=ROW)
    said = [frame.simple_subgoal for frame in env.demonstration()]
    assert said == [env.subtasks[0].text] * 50 + [env.subtasks[1].text] * 50


@pytest.mark.sim
def test_only_the_video_tells_sides_apart() -> None:
    def seen(sides: tuple[str, ...]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        first = env.reset(0, layout=replace(ROW, sides=sides))
        *_, last = env.demonstration(1)
        return last.frames[FRONT], dict(first.frames)

    with make_environment("RouteStick", image_px=128) as env:
        video, now = seen((CLOCKWISE, CLOCKWISE))
        other_video, other_now = seen((COUNTERCLOCKWISE, COUNTERCLOCKWISE))
    assert np.mean(video != other_video) > 0.02
    for camera in (FRONT, WRIST):
        np.testing.assert_array_equal(now[camera], other_now[camera])


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(len(env.save().video) + snapshot.step)
    for difficulty, upstream_mean in {"easy": 246, "medium": 432, "hard": 552}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.1)
