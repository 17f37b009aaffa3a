"""VideoRepick: who swaps with whom, that it is the cube that counts and not its place, and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks import panda, swaps
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Footprint, Spot, is_clear
from dual_system.tasks.oracle import Motions
from dual_system.tasks.placing import BUTTON_ROOM_HALF_M, has_finger_room
from dual_system.tasks.reference.video_repick import LANE_M, Layout, VideoRepick

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]

HOME = np.append(panda.HOME_QPOS, 1.0)
NUM_CUBES = {"easy": 3, "medium": 3, "hard": 15}
NUM_SWAPS = {"easy": {1, 2}, "medium": {2, 3}, "hard": {0}}
LONG_AFTER = 10_000


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("VideoRepick")


def spots_of(layout: Layout) -> list[Spot]:
    return [Spot(x_m=cube.x_m, y_m=cube.y_m, yaw_rad=cube.yaw_rad) for cube in layout.cubes]


def other_than_asked(layout: Layout) -> str:
    return f"cube_{(layout.asked + 1) % len(layout.cubes)}"


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [VideoRepick().sample(np.random.default_rng(seed), difficulty) for seed in range(60)]
    assert {len(layout.cubes) for layout in layouts} == {NUM_CUBES[difficulty]}
    assert {len(layout.swaps) for layout in layouts} == NUM_SWAPS[difficulty]
    assert {layout.repeats for layout in layouts} == {1, 2, 3}
    for layout in layouts:
        colors = [cube.color for cube in layout.cubes]
        assert {colors.count(color) for color in colors} == {5 if difficulty == "hard" else 3}
        taken = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_ROOM_HALF_M)]
        for cube in layout.cubes:
            assert all(is_clear(cube.footprint, other, 0.02) for other in taken)
            taken.append(cube.footprint)
        asked = layout.cubes[layout.asked]
        assert has_finger_room(asked, [cube for cube in layout.cubes if cube is not asked])
        assert abs(layout.button_xy_m[0] + 0.2) <= 0.05
        assert abs(layout.button_xy_m[1]) <= 0.05


@pytest.mark.parametrize("difficulty", ["easy", "medium"])
def test_the_cube_asked_for_swaps_first_and_everybody_with_the_nearest(difficulty: str) -> None:
    for seed in range(60):
        layout = VideoRepick().sample(np.random.default_rng(seed), difficulty)
        movers = [mover for mover, _ in layout.swaps]
        assert movers[0] == layout.asked
        assert len(set(movers)) == len(movers)
        for nth, (mover, partner) in enumerate(layout.swaps):
            now = swaps.spots_after(spots_of(layout), layout.swaps[:nth], LONG_AFTER, LANE_M)
            assert partner == swaps.nearest(now, mover)


def test_every_color_and_every_cube_can_be_asked_for() -> None:
    layouts = [VideoRepick().sample(np.random.default_rng(seed), "easy") for seed in range(60)]
    assert {layout.asked for layout in layouts} == {0, 1, 2}
    assert {layout.cubes[0].color for layout in layouts} == {"red", "blue", "green"}


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_cubes_end_where_the_swaps_lead_and_the_arm_at_home(env: Environment, seed: int) -> None:
    first = env.reset(seed)
    ends = swaps.spots_after(spots_of(env.layout), env.layout.swaps, LONG_AFTER, LANE_M)
    for index, end in enumerate(ends):
        # Being picked up and put down has moved one of them a little, before the swaps.
        np.testing.assert_allclose(env.physics.position_m(f"cube_{index}")[:2], end.xy_m, atol=0.01)
    np.testing.assert_allclose(first.state[:7], panda.HOME_QPOS, atol=0.01)


def test_the_hard_video_ends_when_the_cube_is_put_down(env: Environment) -> None:
    env.reset(2, "hard")
    texts = [frame.simple_subgoal for frame in env.demonstration()]
    assert list(dict.fromkeys(texts)) == ["pick up the cube", "drop the cube on the table"]


def test_nothing_swaps_again_however_long_the_arm_rests_in_the_execution(env: Environment, play: Play) -> None:
    env.reset(0, "easy")
    before = [env.physics.position_m(f"cube_{index}") for index in range(3)]
    motions = Motions(env.physics)
    play(env, motions.rest())
    assert play(env, motions.wait(100)).status is Status.ONGOING
    after = [env.physics.position_m(f"cube_{index}") for index in range(3)]
    np.testing.assert_allclose(after, before, atol=1e-4)


@pytest.mark.parametrize("index", [0, 1])
def test_picking_up_another_cube_fails_with_a_reason(
    env: Environment, play: Play, until_subtask: Until, index: int
) -> None:
    env.reset(0, "easy")
    if index == 1:
        until_subtask(env, 1)
        env.physics.park(f"cube_{env.layout.asked}")  # taken out of the hand: it never lies on the table
        env.physics.refresh()
    snapshot = play(env, Motions(env.physics).pick(other_than_asked(env.layout)))
    assert (snapshot.status, snapshot.subtask_index) == (Status.FAIL, index)
    assert snapshot.reason == f"picked up {other_than_asked(env.layout)}, not the cube of the video"


def test_a_press_soon_after_the_start_is_no_failure_and_later_it_is(env: Environment, play: Play) -> None:
    env.reset(0, "easy")
    assert holding_the_button_down(env, until_step=49).status is Status.ONGOING
    snapshot = holding_the_button_down(env, until_step=50)
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == f"pressed the button before all was done ({env.layout.repeats} times)"


def test_a_press_after_500_steps_is_no_failure_any_more(env: Environment) -> None:
    env.reset(0, "easy")
    for _ in range(500):
        env.step(HOME)
    assert holding_the_button_down(env, until_step=501).status is Status.ONGOING


def test_putting_down_has_a_clock_of_its_own(env: Environment, until_subtask: Until) -> None:
    env.reset(0, "easy")
    lifted = until_subtask(env, 1)
    assert lifted.step > 50
    held = env.physics.command()
    while env.save().memory.putting_steps != 49:
        snapshot = press_and_step(env, held)
        assert snapshot.status is Status.ONGOING
    assert press_and_step(env, held).status is Status.FAIL


def holding_the_button_down(env: Environment, *, until_step: int) -> Snapshot:
    while True:
        snapshot = press_and_step(env, HOME)
        if snapshot.step == until_step or snapshot.status is not Status.ONGOING:
            return snapshot


def press_and_step(env: Environment, action: np.ndarray) -> Snapshot:
    """One step that ends with the button down, as if somebody else pressed it."""
    env.physics.data.joint("button/cap").qpos = -0.014
    env.physics.data.joint("button/cap").qvel = 0.0
    return env.step(action)


def test_once_too_many_fails(env: Environment, play: Play, until_subtask: Until) -> None:
    env.reset(0, "easy")
    until_subtask(env, 2 * env.layout.repeats)
    cube = f"cube_{env.layout.asked}"
    snapshot = play(env, Motions(env.physics).pick(cube))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason == f"picked up {cube} when all was done ({env.layout.repeats} times)"


def test_who_goes_by_the_place_and_not_by_the_cube_loses(env: Environment, play: Play) -> None:
    env.reset(0, "easy", layout=moved_away())
    old = spots_of(env.layout)[env.layout.asked]
    now_m = [env.physics.position_m(f"cube_{index}")[:2] for index in range(3)]
    there = int(np.argmin([np.hypot(*(xy_m - old.xy_m)) for xy_m in now_m]))
    assert there != env.layout.asked
    assert play(env, Motions(env.physics).pick(f"cube_{there}")).status is Status.FAIL


def moved_away() -> Layout:
    """A scene with one swap: the cube asked for cannot be where it was."""
    layout = VideoRepick().sample(np.random.default_rng(0), "easy")
    return replace(layout, swaps=layout.swaps[:1])


@pytest.mark.parametrize("repeats", [1, 3])
def test_the_list_and_the_instruction(repeats: int) -> None:
    layout = replace(VideoRepick().sample(np.random.default_rng(0), "easy"), repeats=repeats)
    picks = [f"pick up the correct cube[ at <>] for the {nth} time" for nth in ("first", "second", "third")[:repeats]]
    texts = [subtask.text for subtask in VideoRepick().subtasks(layout)]
    assert texts[:-1:2] == picks
    assert texts[1:-1:2] == ["put it down"] * repeats
    assert texts[-1] == "press the button[ at <>] to finish"
    again = {
        1: "pick up the same block that was previously picked up again",
        3: "repeatedly pick up and put down the same block that was previously picked up for three times",
    }[repeats]
    assert VideoRepick().instruction(layout) == (
        f"watch the video carefully, then {again}, finally put it down and press the button to stop"
    )


def test_what_must_be_kept_in_mind() -> None:
    layout = replace(VideoRepick().sample(np.random.default_rng(0), "easy"), asked=1, repeats=2, swaps=((1, 0), (2, 1)))
    layout = replace(
        layout, cubes=tuple(replace(cube, y_m=y_m) for cube, y_m in zip(layout.cubes, (0.1, -0.1, 0), strict=True))
    )
    color = layout.cubes[1].color
    begin = f"Demo selected the {color} cube A; after swaps A <-> C, B <-> A, choose "
    assert [VideoRepick().reasoning(layout, index).text for index in range(5)] == [
        begin + "A[ at <>]: pick it up, time 1 of 2.",
        begin + "A[ at <>]: put it down, time 1 of 2.",
        begin + "A[ at <>]: pick it up, time 2 of 2.",
        begin + "A[ at <>]: put it down, time 2 of 2.",
        begin + "the button[ at <>]: A was picked up 2 of 2 times.",
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
    for difficulty, upstream_mean in {"easy": 725, "medium": 730, "hard": 566}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.15)
