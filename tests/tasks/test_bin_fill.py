"""BinFill: what is drawn, what appears when, what counts as put in, and how to lose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.captions import ORDINALS
from dual_system.tasks.counting.bin_fill import BinFill, Layout, Memory
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.geometry import Footprint, is_clear
from dual_system.tasks.oracle import Motions
from dual_system.tasks.scene import BUTTON_HALF_M, CUBE_COLORS

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
HOME = np.append(panda.HOME_QPOS, 1.0)
NUM_COLORS = {"easy": {1}, "medium": {2}, "hard": {3}}
NUM_CUBES = {"easy": {4, 5, 6}, "medium": {8, 9, 10}, "hard": {10, 11, 12}}
NUM_WANTED = {"easy": {1, 2, 3}, "medium": {2, 3, 4}, "hard": {3, 4, 5}}


@pytest.fixture
def env(environment: Callable[[str], Environment]) -> Environment:
    return environment("BinFill")


def start(env: Environment, *, is_filling_up: bool = False) -> tuple[str, str]:
    """Two colors, one cube wanted. Returns the names of a cube of the wanted color and of one of the other."""
    env.reset(4, "medium")
    color, other = list(dict.fromkeys(cube.color for cube in env.layout.cubes))
    env.reset(4, "medium", layout=replace(env.layout, wanted=((color, 1),), is_filling_up=is_filling_up))
    return env.layout.of_color(color)[0], env.layout.of_color(other)[0]


def until(env: Environment, index: int) -> Iterator[np.ndarray]:
    """The oracle's actions until a subtask is current."""
    for action in env.oracle():
        yield action
        if env.save().progress.index == index:
            return


def shown(env: Environment) -> set[str]:
    """Names of the cubes that lie on the table."""
    names = [f"cube_{i}" for i in range(len(env.layout.cubes))]
    return {name for name in names if np.abs(env.physics.position_m(name)).max() < 1}


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    layouts = [BinFill().sample(np.random.default_rng(seed), difficulty) for seed in range(60)]
    for layout in layouts:
        colors = Counter(cube.color for cube in layout.cubes)
        assert all(0 < count <= colors[color] for color, count in layout.wanted)
        assert layout.bin.center_m[0] == pytest.approx(0.05, abs=0.1)
        assert abs(layout.bin.center_m[1]) <= 0.2
        assert abs(layout.bin.yaw_rad) <= np.deg2rad(20)
        taken = [Footprint(center_m=layout.button_xy_m, half_m=BUTTON_HALF_M), layout.bin]
        for cube in layout.cubes:
            assert abs(cube.x_m + 0.1) <= 0.18 + 1e-9
            assert abs(cube.y_m) <= 0.23 + 1e-9
            assert all(is_clear(cube.footprint, other, 0.02) for other in taken)
            taken.append(cube.footprint)
    assert {len({cube.color for cube in layout.cubes}) for layout in layouts} == NUM_COLORS[difficulty]
    assert {len(layout.cubes) for layout in layouts} == NUM_CUBES[difficulty]
    assert {sum(count for _, count in layout.wanted) for layout in layouts} == NUM_WANTED[difficulty]
    assert {layout.is_filling_up for layout in layouts} == {True, False}
    assert {color for layout in layouts for color, _ in layout.wanted} == set(CUBE_COLORS)


@pytest.mark.parametrize(
    ("wanted", "listed"),
    [
        ((("blue", 1),), "one blue cube"),
        ((("green", 3), ("red", 1)), "one red cube and three green cubes"),
        ((("green", 1), ("blue", 2), ("red", 2)), "two red cubes, two blue cubes and one green cube"),
    ],
)
def test_the_sentence_lists_red_then_blue_then_green(wanted: tuple[tuple[str, int], ...], listed: str) -> None:
    layout = replace(BinFill().sample(np.random.default_rng(0), "hard"), wanted=wanted)
    assert BinFill().instruction(layout) == f"put {listed} into the bin, then press the button to stop"


def test_the_list_keeps_the_order_of_colors_and_counts_each() -> None:
    layout: Layout = BinFill().sample(np.random.default_rng(2), "hard")
    layout = replace(layout, wanted=(("green", 2), ("red", 1)))
    assert [subtask.text for subtask in BinFill().subtasks(layout)] == [
        "pick up the first green cube[ at <>]",
        "put it into the bin[ at <>]",
        "pick up the second green cube[ at <>]",
        "put it into the bin[ at <>]",
        "pick up the first red cube[ at <>]",
        "put it into the bin[ at <>]",
        "press the button[ at <>]",
    ]


def test_a_filling_table_shows_one_more_cube_of_each_color_every_50_steps(env: Environment, play: Play) -> None:
    start(env, is_filling_up=True)
    ranks = {name: env.layout.appears_at_step(name) // 50 for name in (f"cube_{i}" for i in range(8))}
    assert sorted(ranks.values())[:3] == [0, 0, 1]
    for step in range(0, 260, 10):
        assert shown(env) >= {name for name, rank in ranks.items() if 50 * rank <= step}
        assert not shown(env) & {name for name, rank in ranks.items() if 50 * rank > step}
        play(env, [HOME] * 10)


def test_a_full_table_shows_all_cubes_at_once(env: Environment) -> None:
    start(env)
    assert len(shown(env)) == len(env.layout.cubes)


def test_a_cube_vanishes_as_it_lands_in_the_bin(env: Environment, play: Play) -> None:
    cube, _ = start(env)
    assert play(env, until(env, 2)).simple_subgoal == "put it into the bin"
    assert env.save().memory.binned == (cube,)
    env.step(HOME)
    assert cube not in shown(env)


def test_a_cube_of_the_wrong_color_fails_when_the_button_is_next(env: Environment, play: Play) -> None:
    cube, other = start(env)
    motions = Motions(env.physics)
    assert play(env, motions.pick(other)).subtask_index == 1  # any cube counts as picked
    snapshot = play(env, motions.drop_into("bin"))
    assert snapshot.status is Status.FAIL
    color_of = {name: env.layout.cubes[int(name[5:])].color for name in (cube, other)}
    assert snapshot.reason == f"put in 1 {color_of[other]} instead of 1 {color_of[cube]}"


def test_one_cube_too_many_fails(env: Environment, play: Play) -> None:
    _, other = start(env)
    play(env, until(env, 2))
    motions = Motions(env.physics)
    assert play(env, motions.pick(other)).status is Status.ONGOING  # picking alone is no harm
    snapshot = play(env, motions.drop_into("bin"))
    assert snapshot.status is Status.FAIL
    assert snapshot.reason.startswith("put in 1 ")


def test_the_button_before_enough_cubes_are_in_fails(env: Environment, play: Play) -> None:
    start(env)
    snapshot = play(env, Motions(env.physics).press("button"))
    assert (snapshot.status, snapshot.reason) == (Status.FAIL, "pressed the button before enough cubes were in")


def test_a_cube_beside_the_bin_does_not_count(env: Environment, play: Play) -> None:
    cube, _ = start(env)
    motions = Motions(env.physics)
    play(env, motions.pick(cube))
    snapshot = play(env, motions.put_down(0.02))
    assert (snapshot.subtask_index, env.save().memory.binned) == (1, ())


@pytest.mark.acceptance
def test_the_oracle_solves_98_of_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        if snapshot.status is Status.SUCCESS:
            steps[env.difficulty].append(snapshot.step)
    assert sum(map(len, steps.values())) >= 98
    for difficulty, upstream_mean in {"easy": 448, "medium": 662, "hard": 851}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.2)


@pytest.mark.parametrize("seed", range(8))
def test_the_list_goes_on_from_whatever_is_in_the_bin(seed: int) -> None:
    """Cubes go in by chance: the list stays as long, tells what was done, and sends nobody to a cube that is in."""
    rng = np.random.default_rng(seed)
    layout = BinFill().sample(rng, "hard")
    drawn = BinFill().subtasks(layout)
    assert [step.text for step in BinFill().subtasks_after(layout, Memory())] == [step.text for step in drawn]
    left = Counter(dict(layout.wanted))
    binned: list[str] = []
    while left.total():
        name = str(rng.choice([n for color in left if left[color] for n in layout.of_color(color) if n not in binned]))
        binned.append(name)
        left -= layout.colors_of([name])
        steps = BinFill().subtasks_after(layout, Memory(binned=tuple(binned)))
        assert len(steps) == len(drawn)
        picked = [step.grounds[0] for step in steps[:-1:2]]
        assert picked[: len(binned)] == binned
        assert layout.colors_of(picked) == dict(layout.wanted)
        assert len(set(picked)) == len(picked)
        for color, count in layout.wanted:
            said = [step.text.split()[3] for step in steps[:-1:2] if step.text.split()[4] == color]
            assert said == list(ORDINALS[:count])
        assert [step.carries[0] for step in steps[1:-1:2]] == picked


@pytest.mark.parametrize("follows", [False, True])
def test_who_begins_with_another_cube_is_sent_to_one_that_is_left(follows: bool) -> None:
    """Upstream's texts go on with the list, and then speak of a cube that is in the bin."""
    with make_environment("BinFill", render=False, texts_follow=follows) as env:
        env.reset(4, "medium")
        color = env.layout.cubes[0].color
        first, second = env.layout.of_color(color)[:2]
        env.reset(4, "medium", layout=replace(env.layout, wanted=((color, 2),), is_filling_up=False))
        motions = Motions(env.physics)
        for motion in (motions.pick(second), motions.drop_into("bin")):
            for action in motion:
                env.step(action)
        snapshot = env.step(action)
        assert snapshot.simple_subgoal == f"pick up the second {color} cube"
        left = env.subtasks[2].grounds
        assert left == ((first,) if follows else (second,))
        assert ("<" in snapshot.grounded_subgoal) == follows, "what is in the bin has vanished and is seen nowhere"


def test_one_too_many_leaves_the_list_as_long() -> None:
    layout = BinFill().sample(np.random.default_rng(2), "medium")
    others = [f"cube_{i}" for i, cube in enumerate(layout.cubes) if cube.color not in dict(layout.wanted)]
    names = others or layout.of_color(layout.wanted[0][0])
    steps = BinFill().subtasks_after(layout, Memory(binned=tuple(names)))
    assert len(steps) == len(BinFill().subtasks(layout))
