"""A script that is made to fail a grasp lifts nothing with it, and goes on to solve the episode."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import FailedGrasp, Motions

SEED = 6
Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]


@pytest.mark.parametrize(
    ("task", "offset"),  # a cube, a container, a bar
    [("PickHighlight", (0, 0, 1)), ("PickHighlight", (-1, 1, 0)), ("VideoUnmask", (1, 0, 0)), ("InsertPeg", (0, 0, 1))],
)
def test_it_lifts_nothing_and_recovers(
    environment: Callable[[str], Environment], task: str, offset: tuple[int, int, int]
) -> None:
    env = environment(task)
    env.reset(SEED)
    motions = Motions(env.physics, FailedGrasp(before=0, offset=offset))
    closings = 0
    was_open = True
    for action in env.oracle(motions):
        closings += bool(motions.num_grasps and was_open and action[7] < 0)
        was_open = action[7] > 0
        snapshot = env.step(action)
        if closings == 1:
            assert snapshot.status is Status.ONGOING  # one lifted target ends both episodes
        if snapshot.status is not Status.ONGOING:
            break
    assert snapshot.status is Status.SUCCESS
    assert closings == 2


def test_it_comes_before_the_grasp_that_was_named(environment: Callable[[str], Environment], play: Play) -> None:
    env = environment("PickXtimes")
    lengths = []
    for failed in (None, FailedGrasp(before=1, offset=(0, 0, 1)), FailedGrasp(before=2, offset=(0, 0, 1))):
        env.reset(SEED)
        motions = Motions(env.physics, failed)
        lengths.append(play(env, env.oracle(motions)).step)
        assert motions.num_grasps == 2
    plain, recovering, beyond_the_last = lengths
    assert recovering > plain == beyond_the_last
