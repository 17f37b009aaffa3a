"""Shoves: a seed's alone, never under the hand, to a free place near by; the oracle and its words follow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dual_system.data import rollout
from dual_system.data.episode import Row
from dual_system.data.jobs import Job, Look
from dual_system.data.rollout import UnsolvedError, play
from dual_system.data.shove import SHOVES, ShoveConfig, Shoves, is_shoved
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.oracle import Motions

TASK = "PickHighlight"
SEEDS = range(2_000_000, 2_000_006)
AT_ONCE = ShoveConfig(mean_wait_s=0.05)
HOVERS_M = 0.148
PICK_FIRST, PUT_DOWN = 1, 2  # subtasks of a scene with several targets; 0 is the button


def job(shove_share: float = 1.0) -> Job:
    return Job(
        task=TASK,
        slot=1,
        image_px=32,
        max_steps=1300,
        look=Look(),
        difficulties=("medium",),
        texts_follow=True,
        shove_share=shove_share,
    )


@pytest.fixture(scope="module")
def environment() -> Iterator[Environment]:
    with make_environment(TASK, render=False, texts_follow=True) as env:
        yield env


def played(environment: Environment, seed: int, shove_share: float = 1.0) -> list[Row]:
    found: list[Row] = []
    play(environment, job(shove_share), seed, take=lambda row, frames: found.append(row))
    return found


@pytest.fixture(scope="module")
def episodes(environment: Environment) -> dict[int, list[Row]]:
    """Some seeds' rows, played one after another."""
    return {seed: played(environment, seed) for seed in SEEDS[:3]}


def ready(environment: Environment, seed: int) -> Snapshot:
    """The button pressed, the hand above it: nothing is in the way of a shove."""
    snapshot = environment.reset(seed, "medium")
    script = environment.oracle()
    while snapshot.subtask_index < PICK_FIRST or environment.physics.tcp_transform()[2, 3] < HOVERS_M:
        snapshot = environment.step(next(script))
    return snapshot


def poses(environment: Environment) -> dict[str, np.ndarray]:
    cubes = [name for name in environment.physics.props if name.startswith("cube_")]
    return {name: environment.physics.pose(name) for name in cubes[: len(environment.layout.cubes)]}


def moved(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> list[str]:
    return [name for name, pose in before.items() if not np.array_equal(pose, after[name])]


def test_one_seed_is_one_episode(environment: Environment, episodes: dict[int, list[Row]]) -> None:
    again, first = played(environment, SEEDS[0]), episodes[SEEDS[0]]
    np.testing.assert_array_equal([row.state for row in again], [row.state for row in first])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_seeds_is_shoved(share: float) -> None:
    assert np.mean([is_shoved(seed, share) for seed in range(2000)]) == pytest.approx(share, abs=0.04)


def test_without_a_share_the_episode_is_the_oracle_s_alone(environment: Environment) -> None:
    rows = played(environment, SEEDS[0], shove_share=0.0)
    snapshot, script = environment.reset(SEEDS[0], "medium"), environment.oracle()
    for row in rows:
        action = next(script)
        np.testing.assert_array_equal(row.action, action)
        snapshot = environment.step(action)
    assert snapshot.status is Status.SUCCESS


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_shoved_stands_near_by_on_free_table(environment: Environment, seed: int) -> None:
    ready(environment, seed)
    before = poses(environment)
    shoves = Shoves(environment.physics, environment.subtasks, seed, AT_ONCE)
    shoves.step(PICK_FIRST)
    after = poses(environment)
    (name,) = moved(before, after)
    assert name in environment.subtasks[PICK_FIRST].grounds or name in environment.subtasks[PICK_FIRST + 2].grounds
    far_m = np.linalg.norm((after[name] - before[name])[:2])
    assert SHOVES.least_m <= far_m <= SHOVES.most_m
    assert after[name][2] == before[name][2]
    others = [pose[:2] for other, pose in after.items() if other != name]
    assert np.linalg.norm(np.array(others) - after[name][:2], axis=1).min() >= SHOVES.free_m
    turn = abs(float(before[name][3:] @ after[name][3:]))  # cosine of half the angle
    assert turn >= np.cos(SHOVES.most_turned_rad / 2) - 1e-9
    assert np.linalg.norm(after[name][3:]) == pytest.approx(1.0)


def test_a_subtask_has_one_shove_and_only_picking_has_any(environment: Environment) -> None:
    ready(environment, SEEDS[0])
    shoves = Shoves(environment.physics, environment.subtasks, SEEDS[0], AT_ONCE)
    for index, expected in ((0, 0), (PUT_DOWN, 0), (PICK_FIRST, 1), (PICK_FIRST, 1)):
        shoves.step(index)
        assert shoves.num_shoved == expected


def test_nothing_moves_under_the_hand(environment: Environment) -> None:
    ready(environment, SEEDS[0])
    now = environment.physics.tcp_transform()[2, 3]
    target = environment.subtasks[PICK_FIRST].grounds[0]
    high_m = now - environment.physics.position_m(target)[2]
    for above_m, expected in ((high_m + 0.001, 0), (high_m - 0.001, 1)):
        config = replace(AT_ONCE, tool_above_m=above_m)
        shoves = Shoves(environment.physics, environment.subtasks, SEEDS[0], config)
        shoves.step(PICK_FIRST)
        assert shoves.num_shoved == expected


def test_without_free_table_nothing_moves(environment: Environment) -> None:
    ready(environment, SEEDS[0])
    before = poses(environment)
    Shoves(environment.physics, environment.subtasks, SEEDS[0], replace(AT_ONCE, free_m=20.0)).step(PICK_FIRST)
    assert not moved(before, poses(environment))


def test_the_oracle_and_its_words_follow(episodes: dict[int, list[Row]]) -> None:
    """Every scene is solved; places change within a subgoal, and that is no transition."""
    changes = 0
    for rows in episodes.values():
        for before, after in pairwise(rows):
            if "<" in before.grounded_subgoal and before.subgoal == after.subgoal:
                is_changed = before.grounded_subgoal != after.grounded_subgoal
                changes += is_changed
                assert not (is_changed and after.is_transition)
    assert changes >= len(episodes) // 2


def test_an_oracle_that_does_not_watch_closes_where_the_thing_was(
    environment: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "Motions", lambda physics, fails, watches: Motions(physics, fails))

    def play_all() -> None:
        for seed in SEEDS:
            played(environment, seed)

    with pytest.raises(UnsolvedError):
        play_all()
