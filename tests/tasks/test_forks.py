"""Two pasts of one present: the branches look the same to the last bit, and what must be done next is not the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.forks import MAX_SEAM, ForkError, fork
from dual_system.tasks.pairs import Pair, find_pair, oracle_chunk
from dual_system.tasks.task import make_task, task_names

EnvironmentOf = Callable[[str], Environment]
Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]

RETOLD = tuple(name for name in task_names() if make_task(name).can_be_forked() and not make_task(name).repeats_itself)
VIDEO_SEEDS = {
    "PatternLock": 1,
    "RouteStick": 3,
    "MoveCube": 0,
    "InsertPeg": 2,
    "VideoRepick": 3,
    "VideoPlaceButton": 0,
}
SEEDS = {"PickHighlight": 1, "BinFill": 8, "PickXtimes": 1, "SwingXtimes": 1, "StopCube": 0, "VideoUnmaskSwap": 2}
SEEDS |= VIDEO_SEEDS
"""Where pairs are known to be."""

LIKE_ANOTHER = (
    "BinFill",
    "InsertPeg",
    "RouteStick",
    "VideoRepick",
    "VideoPlaceButton",
    "SwingXtimes",
    "VideoUnmaskSwap",
)
"""Tasks whose past is told like that of another one here; a pair takes seconds to find."""


def each_of(names: Iterable[str]) -> list[Any]:
    return [pytest.param(name, marks=[pytest.mark.acceptance] * (name in LIKE_ANOTHER)) for name in names]


every_kind = pytest.mark.parametrize("name", each_of(SEEDS))
every_video = pytest.mark.parametrize("name", each_of(VIDEO_SEEDS))


@pytest.fixture(scope="module")
def pair_of(environment: EnvironmentOf) -> Callable[[str], Pair]:
    """One pair per task, without pictures."""

    @cache
    def find(name: str) -> Pair:
        pair = find_pair(environment(name), make_environment(name, render=False), name, SEEDS[name])
        assert pair is not None
        return pair

    return find


def played(env: Environment, num_steps: int, seed: int = 2, difficulty: str = "hard") -> Environment:
    env.reset(seed, difficulty)
    for action in islice(env.oracle(), num_steps):
        env.step(action)
    return env


@pytest.mark.parametrize("name", RETOLD)
def test_retold_layouts_are_of_the_same_task_and_instruction(name: str) -> None:
    task = make_task(name)
    for difficulty in DIFFICULTIES:
        for seed in range(6):
            layout = task.sample(np.random.default_rng(seed), difficulty)
            for other in task.retold(layout):
                assert other != layout
                assert task.instruction(other) == task.instruction(layout)


def test_the_twin_was_shown_other_things_under_the_same_actions(environment: EnvironmentOf) -> None:
    found = fork(played(environment("PickHighlight"), 110))
    assert not found.is_cut
    assert found.seam == 0
    assert len(found.own.past) == len(found.twin.past) == 110
    assert found.own.now.physics.integration.tobytes() == found.twin.now.physics.integration.tobytes()
    assert set(found.own.now.layout.targets).isdisjoint(found.twin.now.layout.targets)
    for own, twin in zip(found.own.past, found.twin.past, strict=True):
        is_lit = 10 <= own.step <= 100
        assert (own.physics.integration.tobytes() != twin.physics.integration.tobytes()) == is_lit
        np.testing.assert_array_equal(own.actions, twin.actions)


def test_forking_changes_nothing(environment: EnvironmentOf) -> None:
    env = played(environment("PickHighlight"), 110)
    before = env.save()
    fork(env)
    after = env.save()
    assert after.physics.integration.tobytes() == before.physics.integration.tobytes()
    for what in ("step", "layout", "memory", "progress", "caption"):
        assert getattr(after, what) == getattr(before, what)


@pytest.mark.parametrize(
    ("name", "num_steps", "variant", "complaint"),
    [
        ("PickHighlight", 5, 0, "by step 5 nothing has been shown yet"),
        ("PickHighlight", 60, 0, "at step 60 one still sees which past it was"),
        ("ButtonUnmask", 20, 0, "at step 20 one still sees which past it was"),
        ("PickHighlight", 110, 1, "no variant 1 of this episode's past at step 110; there are 1"),
        ("PickXtimes", 150, 0, "no variant 0 of this episode's past at step 150; there are 0"),
    ],
)
def test_there_is_no_twin(environment: EnvironmentOf, name: str, num_steps: int, variant: int, complaint: str) -> None:
    with pytest.raises(ForkError, match=complaint):
        fork(played(environment(name), num_steps), variant)


def test_what_did_not_come_from_its_reset_is_not_forked(environment: EnvironmentOf) -> None:
    env = played(environment("PickHighlight"), 110)
    env.physics.place("cube_0", np.array([0.1, 0.1, 0.02, 1, 0, 0, 0]))
    env.physics.refresh()
    with pytest.raises(ForkError, match="did not come here from its own reset"):
        fork(env)


@every_kind
def test_the_scripts_of_a_pair_go_apart(pair_of: Callable[[str], Pair], name: str) -> None:
    pair = pair_of(name)
    assert pair.own.oracle.shape == pair.twin.oracle.shape == (20, 8)
    assert np.abs(pair.own.oracle - pair.twin.oracle).max() > 0.02
    assert pair.own.subgoal != pair.twin.subgoal
    assert pair.own.reasoning != pair.twin.reasoning


@every_kind
def test_only_what_repeats_itself_is_cut(pair_of: Callable[[str], Pair], name: str) -> None:
    pair = pair_of(name)
    assert pair.is_cut == (name not in RETOLD)
    assert pair.seam <= MAX_SEAM * (pair.is_cut or name in VIDEO_SEEDS)
    if pair.is_cut:
        assert len(pair.own.steps) > len(pair.twin.steps)  # a round takes more than a second
    else:
        own, twin = (told.states[~told.is_demonstration] for told in (pair.own, pair.twin))
        np.testing.assert_array_equal(own, twin)


@every_video
def test_only_the_videos_of_a_pair_differ(pair_of: Callable[[str], Pair], name: str) -> None:
    own, twin = (told.states[told.is_demonstration] for told in (pair_of(name).own, pair_of(name).twin))
    assert own.shape != twin.shape or not np.array_equal(own, twin)


@pytest.mark.parametrize("name", each_of(["PatternLock", "MoveCube", "InsertPeg"]))
def test_after_either_video_the_robot_finds_the_same_world(environment: EnvironmentOf, play: Play, name: str) -> None:
    """From the first observation on it is the same to the bit, and each branch's script succeeds in it."""
    env = environment(name)
    env.reset(VIDEO_SEEDS[name])
    scripted_m = env.physics.data.mocap_pos.copy()
    found = fork(env)
    assert found.own.now.physics.integration.tobytes() == found.twin.now.physics.integration.tobytes()
    env.reset(0, found.twin.now.difficulty, layout=found.twin.now.layout)
    gaps_m = np.linalg.norm(on_the_table(scripted_m)[:, None] - on_the_table(env.physics.data.mocap_pos), axis=-1)
    assert max(gaps_m.min(axis=0).max(), gaps_m.min(axis=1).max()) < 1e-5  # whichever of several dots lies where
    for branch in (found.own, found.twin):
        env.restore(branch.now)
        last = play(env, env.oracle())
        assert last.status.value == "success", last.reason


def on_the_table(positions_m: np.ndarray) -> np.ndarray:
    """The places of what is not parked."""
    return positions_m[np.abs(positions_m[:, 0]) < 1]


def test_a_video_that_leaves_things_elsewhere_has_no_twin(
    environment: EnvironmentOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = environment("MoveCube")
    env.reset(0)
    asked = env.layout.asked
    moved = replace(env.layout, asked=replace(asked, cube=replace(asked.cube, x_m=asked.cube.x_m + 0.01)))
    monkeypatch.setattr(type(make_task("MoveCube")), "retold", lambda task, layout: (moved,))
    with pytest.raises(ForkError, match=r"the other video leaves things 0\.010 rad or m elsewhere"):
        fork(env)


def test_another_world_is_found_only_at_first(environment: EnvironmentOf) -> None:
    env = played(environment("MoveCube"), 3)
    with pytest.raises(RuntimeError, match="at step 3; another world can only be found at step 0"):
        env.begin_in(env.save().physics)


@pytest.mark.parametrize("name", each_of(["PickXtimes", "SwingXtimes", "StopCube"]))
def test_a_cut_twin_has_a_whole_round_less_behind_it(pair_of: Callable[[str], Pair], name: str) -> None:
    left = [telling.reasoning.partition("remaining: ")[2][0] for telling in (pair_of(name).own, pair_of(name).twin)]
    assert int(left[1]) > int(left[0])


@pytest.mark.parametrize("name", ["PickHighlight", "PickXtimes"])
def test_each_branch_can_be_played_to_its_own_success(environment: EnvironmentOf, play: Play, name: str) -> None:
    env = environment(name)
    env.reset(0, "easy")
    found = None
    for action in env.oracle():
        if env.step(action).step % 20 == 0:
            try:
                found = fork(env)
            except ForkError:
                continue
            if not np.allclose(oracle_chunk(env, found.own.now), oracle_chunk(env, found.twin.now)):
                break
            env.restore(found.own.now)
    assert found is not None
    for branch in (found.own, found.twin):
        env.restore(branch.now)
        last = play(env, env.oracle())
        assert last.status.value == "success", last.reason


def test_patterns_part_at_every_button_and_stay_on_the_grid() -> None:
    task = make_task("PatternLock")
    layout = replace(task.sample(np.random.default_rng(0), "hard"), pattern=(12, 13, 14, 9))
    for other in task.retold(layout):
        ways = np.array([divmod(button, layout.side) for button in other.pattern])
        assert len(set(other.pattern)) == len(layout.pattern)
        assert np.abs(np.diff(ways, axis=0)).max(axis=1).tolist() == [1, 1, 1]
    parted = [
        [ours == theirs for ours, theirs in zip(layout.pattern, other.pattern, strict=True)].index(False)
        for other in task.retold(layout)
    ]
    assert set(parted) == {1, 2, 3}
    assert len(parted) == len(set(other.pattern for other in task.retold(layout)))


@pytest.mark.sim
def test_after_either_video_the_picture_is_the_same_and_videos_can_be_looked_at_more_often_and_at_their_end() -> None:
    name = "PatternLock"
    with make_environment(name, image_px=64) as env, make_environment(name, render=False) as other:
        once, twice = (
            find_pair(env, other, name, VIDEO_SEEDS[name], demo_hz=hz, demo_to_its_end=hz > 1) for hz in (1, 2)
        )
        assert once is not None  # `find_pair` raises unless the presents are the same picture
        assert twice is not None
        assert set(once.frames) == {"front", "wrist"}
        for camera in once.frames:
            own, twin = once.own.frames[camera], once.twin.frames[camera]
            assert own.shape != twin.shape or not np.array_equal(own, twin)
        looks, more = (each.own.steps[each.own.is_demonstration] for each in (once, twice))
        assert np.diff(looks).tolist() == [20] * (len(looks) - 1)
        assert np.diff(more)[:-1].tolist() == [10] * (len(more) - 2)
        env.reset(VIDEO_SEEDS[name])
        *_, last = env.demonstration(look_hz=1)
        assert last.step % 10, "it lies between two looks"
        assert more[-1] == last.step
        past = [each.own.steps[~each.own.is_demonstration].tolist() for each in (once, twice)]
        assert past[0] == past[1]


@pytest.mark.sim
def test_the_two_presents_are_one_picture_and_the_pasts_are_not() -> None:
    with make_environment("PickHighlight", image_px=64) as env:
        pair = find_pair(env, make_environment("PickHighlight", render=False), "PickHighlight", 1)
        assert pair is not None
        assert pair.frames["front"].shape == (64, 64, 3)
        assert pair.own.frames["front"].shape == (len(pair.own.steps), 64, 64, 3)
        is_same = [
            np.array_equal(*frames) for frames in zip(pair.own.frames["front"], pair.twin.frames["front"], strict=True)
        ]
        lit = [10 <= step <= 100 for step in pair.own.steps]
        assert is_same == [not shown for shown in lit]
