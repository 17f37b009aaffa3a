"""PatternLock: what patterns there are, what turns red, what the dots show, and how to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise

import numpy as np
import pytest

from dual_system.tasks import panda, predicates
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.imitation.pattern_lock import Layout, PatternLock
from dual_system.tasks.imitation.traces import RED_STEPS, TRAIL_STEPS
from dual_system.tasks.oracle import Motions
from dual_system.tasks.scene import FRONT, WRIST

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
SIDE = {"easy": 3, "medium": 4, "hard": 5}
LENGTHS = {"easy": {2, 3, 4}, "medium": {3, 4, 5}, "hard": {4, 5, 6, 7, 8}}
CORNER = Layout(side=4, pattern=(5, 10, 14))


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("PatternLock")


def is_red(env: Environment, button: int) -> bool:
    return bool(env.physics.model.geom(f"target_{button}/red/0").rgba[3] > 0)


def still(env: Environment, num_steps: int) -> Iterator[np.ndarray]:
    """Keeps what is commanded now."""
    command = env.physics.command()
    return iter([command] * num_steps)


def steps(env: Environment) -> Iterator[Snapshot]:
    """The oracle's episode."""
    for action in env.oracle():
        yield (snapshot := env.step(action))
        if snapshot.status is not Status.ONGOING:
            return


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_patterns_go_from_neighbour_to_neighbour_and_nowhere_twice(difficulty: str) -> None:
    layouts = [PatternLock().sample(np.random.default_rng(seed), difficulty) for seed in range(200)]
    for layout in layouts:
        assert layout.side == SIDE[difficulty]
        assert len(set(layout.pattern)) == len(layout.pattern)
        assert all(0 <= button < layout.side**2 for button in layout.pattern)
        for start, end in pairwise(layout.pattern):
            assert np.abs(np.subtract(divmod(end, layout.side), divmod(start, layout.side))).max() == 1
    assert {len(layout.pattern) for layout in layouts} == LENGTHS[difficulty]
    assert {layout.pattern[0] for layout in layouts} == set(range(SIDE[difficulty] ** 2))


def test_the_grid_is_ten_centimetres_wide_per_button_about_its_centre() -> None:
    for side in SIDE.values():
        grid_m = [Layout(side=side, pattern=(0, 1)).xy_m(button) for button in range(side**2)]
        np.testing.assert_allclose(np.mean(grid_m, axis=0), [-0.1, 0.0], atol=1e-12)
        np.testing.assert_allclose(np.subtract(grid_m[1], grid_m[0]), [0.0, 0.1], atol=1e-12)
        np.testing.assert_allclose(np.subtract(grid_m[side], grid_m[0]), [0.1, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("end", "direction"),
    [
        (7, "forward"),
        (8, "forward-left"),
        (5, "left"),
        (2, "backward-left"),
        (1, "backward"),
        (0, "backward-right"),
        (3, "right"),
        (6, "forward-right"),
    ],
)
def test_directions_are_the_robots(end: int, direction: str) -> None:
    layout = Layout(side=3, pattern=(4, end))
    assert layout.directions() == (direction,)
    dx_m, dy_m = np.subtract(layout.xy_m(end), layout.xy_m(4))
    assert (dx_m > 0) == ("forward" in direction)
    assert (dy_m > 0) == ("left" in direction)


def test_the_list_the_instruction_and_the_reasoning(env: Environment) -> None:
    env.reset(1, layout=CORNER)
    assert [subtask.text for subtask in env.subtasks] == ["move forward-left", "move forward"]
    assert env.instruction == (
        "watch the video carefully, then use the stick attached to the robot to retrace the same pattern"
    )
    assert env.reasoning() == (
        "Demo sequence: target_0 at <74, 115> -> target_1 at <92, 140> -> target_2 at <113, 141>; modes: "
        "forward-left, forward. Reproduce exactly; next is target_0 -> target_1, forward-left. "
        "Subgoal: move forward-left."
    )


def test_the_reasoning_remembers_where_a_hidden_button_was_seen(env: Environment) -> None:
    """With the tip over the front row, the hand hides what is behind it; the video showed it."""
    env.reset(2, layout=Layout(side=5, pattern=(23, 18, 13, 8, 3)))
    now = env.physics.save()
    assert env.reasoning().count(" at <") == 5
    np.testing.assert_array_equal(env.physics.save().integration, now.integration)


def test_execution_begins_over_the_first_button_which_is_red(env: Environment) -> None:
    first = env.reset(1, layout=CORNER)
    np.testing.assert_allclose(first.tcp_pose[:3], [-0.15, -0.05, 0.07], atol=1e-3)
    assert [button for button in range(16) if is_red(env, button)] == [5]


def test_buttons_that_a_grid_has_not_are_away(env: Environment) -> None:
    env.reset(0, layout=Layout(side=3, pattern=(0, 1)))
    away = [np.abs(env.physics.position_m(f"target_{button}")).max() > 5 for button in range(25)]
    assert away == [False] * 9 + [True] * 16


def test_a_button_turns_red_one_step_after_its_touch_and_stays_so_40_steps_after_the_last(env: Environment) -> None:
    env.reset(1, layout=CORNER)
    touched, red = [], []
    for _ in steps(env):
        touched.append(predicates.is_tool_over(env.physics, "target_5", within_m=0.01, below_z_m=0.1))
        red.append(is_red(env, 5))
    last = max(step for step, is_touched in enumerate(touched) if is_touched)
    assert max(step for step, is_lit in enumerate(red) if is_lit) == last + 1 + RED_STEPS
    assert all(red[: last + 1])


def test_dots_lie_where_the_low_tip_has_been_in_the_last_two_seconds(env: Environment) -> None:
    env.reset(1, layout=CORNER)
    way_m = [snapshot.tcp_pose[:3] for snapshot in steps(env)]
    dots_m = np.array([env.physics.position_m(f"dot_{index}") for index in range(TRAIL_STEPS)])
    recent_m = np.array(way_m[-TRAIL_STEPS:])
    np.testing.assert_allclose(np.sort(dots_m[:, 0]), np.sort(recent_m[:, 0]), atol=1e-12)
    np.testing.assert_allclose(dots_m[:, 2], 0.01)


def test_a_high_tip_leaves_no_dots_and_touches_nothing(env: Environment, play: Play) -> None:
    env.reset(1, layout=CORNER)
    lifted = env.physics.tcp_transform()
    lifted[:3, 3] = (-0.05, -0.05, 0.11)  # over target_9, which is not of the pattern
    snapshot = play(env, Motions(env.physics).move(lifted))
    snapshot = play(env, still(env, TRAIL_STEPS))
    assert snapshot.status is Status.ONGOING
    assert all(np.abs(env.physics.position_m(f"dot_{index}")).max() > 5 for index in range(TRAIL_STEPS))


def test_touching_a_button_beside_the_pattern_fails_with_a_reason(env: Environment, play: Play) -> None:
    env.reset(1, layout=CORNER)
    snapshot = play(env, Motions(env.physics).point_at("target_9"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "touched target_9 on the way from target_5 to target_10")


def test_skipping_a_button_fails(env: Environment, play: Play) -> None:
    env.reset(1, layout=Layout(side=4, pattern=(5, 6, 10)))
    snapshot = play(env, Motions(env.physics).point_at("target_10"))
    assert snapshot.status is Status.FAIL
    assert snapshot.subtask_index == 0


def test_going_back_to_the_button_before_the_last_fails(env: Environment, play: Play) -> None:
    env.reset(1, layout=CORNER)
    assert play(env, Motions(env.physics).point_at("target_10")).subtask_index == 1
    snapshot = play(env, Motions(env.physics).point_at("target_5"))
    assert (snapshot.status, snapshot.reason) == (
        Status.FAIL,
        "touched target_5 on the way from target_10 to target_14",
    )


def test_waiting_over_the_last_button_is_no_mistake(env: Environment, play: Play) -> None:
    env.reset(1, layout=CORNER)
    snapshot = play(env, still(env, 30))
    assert (snapshot.status, snapshot.subtask_index) == (Status.ONGOING, 0)
    assert play(env, env.oracle()).status is Status.SUCCESS


def test_two_in_one_sweep_are_two_touches(env: Environment, play: Play) -> None:
    env.reset(1, layout=Layout(side=4, pattern=(4, 5, 6)))
    snapshot = play(env, Motions(env.physics).point_at("target_6"))
    assert snapshot.status is Status.SUCCESS


def test_the_video_is_one_part_per_move(env: Environment) -> None:
    env.reset(1, layout=CORNER)
    frames = list(env.demonstration())
    assert list(dict.fromkeys(frame.simple_subgoal for frame in frames)) == ["move forward-left", "move forward"]
    np.testing.assert_allclose(frames[0].tcp_pose[:3], [-0.15, -0.05, 0.07], atol=2e-3)
    np.testing.assert_allclose(frames[-1].tcp_pose[:3], [0.05, 0.05, 0.07], atol=2e-3)


@pytest.mark.sim
def test_only_the_video_tells_patterns_apart_that_begin_alike() -> None:
    def seen(pattern: tuple[int, ...]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        first = env.reset(1, layout=Layout(side=4, pattern=pattern))
        *_, last = env.demonstration(1)
        return last.frames[FRONT], dict(first.frames)

    with make_environment("PatternLock", image_px=128) as env:
        video, now = seen((5, 10, 14))
        other_video, other_now = seen((5, 8, 12))
    assert np.mean(video != other_video) > 0.02
    for camera in (FRONT, WRIST):  # the arm comes back from elsewhere, to within a fraction of a pixel
        assert np.mean(np.abs(now[camera].astype(int) - other_now[camera]) > 30) < 1e-3


def test_doing_what_the_gripper_robot_would_is_harmless(env: Environment) -> None:
    """There is no gripper to open."""
    env.reset(1, layout=CORNER)
    snapshot = env.step(np.append(env.physics.command()[:7], 1.0))
    assert snapshot.command[7] == -1.0
    assert snapshot.state[7] == 0.0
    assert panda.robot_in(env.physics.model) is PatternLock.robot


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(len(env.save().video) + snapshot.step)
    for difficulty, upstream_mean in {"easy": 139, "medium": 204, "hard": 350}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.1)
