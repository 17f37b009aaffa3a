"""Coordinates that follow: corrected when their thing is pushed over the table, and at no other time."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment

SEED = 3


@pytest.fixture(scope="module")
def worlds() -> Iterator[dict[bool, Environment]]:
    """By whether texts follow."""
    found = {follow: make_environment("PickXtimes", render=False, texts_follow=follow) for follow in (False, True)}
    yield found
    for environment in found.values():
        environment.close()


def pushed(environment: Environment, by_m: tuple[float, float, float]) -> tuple[Snapshot, Snapshot]:
    """What is seen before and after the thing of the first subgoal was put elsewhere, the arm at rest."""
    first = environment.reset(SEED, "easy")
    (body,) = environment.subtasks[0].grounds
    pose = environment.physics.pose(body)
    pose[:3] += by_m
    environment.physics.place(body, pose)
    return first, environment.step(first.command)


def yx_px(snapshot: Snapshot) -> np.ndarray:
    return np.array(re.findall(r"\d+", snapshot.grounded_subgoal)[:2], float)


@pytest.mark.parametrize("by_m", [(0.0, 0.0, 0.0), (0.005, -0.005, 0.0), (0.03, 0.03, 0.05)])
def test_what_was_not_pushed_keeps_its_words(worlds: dict[bool, Environment], by_m: tuple[float, float, float]) -> None:
    for environment in worlds.values():
        before, after = pushed(environment, by_m)
        assert before.grounded_subgoal == after.grounded_subgoal


@pytest.mark.parametrize("by_m", [(0.03, 0.0, 0.0), (0.0, 0.04, 0.0)])
def test_what_was_pushed_is_spoken_of_where_it_is(
    worlds: dict[bool, Environment], by_m: tuple[float, float, float]
) -> None:
    before, after = pushed(worlds[False], by_m)
    assert before.grounded_subgoal == after.grounded_subgoal
    before, after = pushed(worlds[True], by_m)
    moved_px = yx_px(after) - yx_px(before)
    assert 2 < np.abs(moved_px).max() < 30
    assert np.sign(moved_px[np.abs(moved_px).argmax()]) == 1
    assert (before.subgoal_index, before.simple_subgoal) == (after.subgoal_index, after.simple_subgoal)
    assert worlds[True].step(after.command).grounded_subgoal == after.grounded_subgoal


@pytest.mark.parametrize("follow", [False, True])
def test_what_was_dropped_on_its_way_is_to_be_picked_up_again(worlds: dict[bool, Environment], follow: bool) -> None:
    """Upstream's words go on as if it were in the hand; the oracle that knows of it solves the task all the same."""
    environment = worlds[follow]
    environment.reset(SEED, "easy")
    picked, placing = (subtask.grounds[0] for subtask in environment.subtasks[:2])
    script = environment.oracle()
    for action in script:
        snapshot = environment.step(action)
        if snapshot.subgoal_index == 1:
            break
    assert placing != picked
    opened = snapshot.command.copy()
    opened[-1] = 1.0
    spoken_of = [environment.step(opened).subgoal_index for _ in range(30)]
    assert spoken_of[0] == 1  # it is falling
    assert spoken_of[-1] == (0 if follow else 1)
    assert environment.save().progress.index == 1
    if not follow:
        return
    assert environment.step(opened).grounded_subgoal.startswith(environment.subtasks[0].text[:10])
    found = [snapshot.subgoal_index]
    for action in environment.oracle():
        snapshot = environment.step(action)
        found.append(snapshot.subgoal_index)
        if snapshot.status is not Status.ONGOING:
            break
    assert snapshot.status is Status.SUCCESS
    assert list(dict.fromkeys(found[1:]))[:2] == [0, 1]
