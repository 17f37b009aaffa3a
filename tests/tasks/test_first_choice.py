"""First choices: the oracle's are right, another script's are wrong, and they stay what they were."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.oracle import Motions
from dual_system.tasks.task import Task

SEED = 300_000


def retold(task: Task[Any, Any], layout: Any) -> Iterator[Any]:
    """Layouts with the same instruction and another right answer at once."""
    for other in task.retold(layout):
        if task.name != "PatternLock" or other.pattern[1] != layout.pattern[1]:
            yield other


def miscounted(task: Task[Any, Any], layout: Any) -> Iterator[Any]:
    yield replace(layout, repeats=layout.repeats - 1)
    yield replace(layout, repeats=layout.repeats + 1)


OTHERS: dict[str, Callable[[Task[Any, Any], Any], Iterable[Any]]] = {
    "VideoUnmask": retold,
    "PickHighlight": retold,
    "MoveCube": retold,
    "PickXtimes": miscounted,
    "SwingXtimes": miscounted,
    "PatternLock": retold,
}


@pytest.fixture(params=OTHERS)
def env(request: pytest.FixtureRequest, environment: Callable[[str], Environment]) -> Environment:
    """In a scene whose count, if it has one, is two or three."""
    env = environment(request.param)
    seed = SEED
    env.reset(seed, "easy")
    while getattr(env.layout, "repeats", 2) == 1:
        seed += 1
        env.reset(seed, "easy")
    return env


def chosen(env: Environment, layout: Any) -> Snapshot:
    """Plays another layout's script up to the first choice, or to the end."""
    motions = Motions(env.physics)
    for subtask in env.task.subtasks(layout):
        for action in subtask.motion(motions):
            snapshot = env.step(action)
            if snapshot.first_choice is not None or snapshot.status is not Status.ONGOING:
                return snapshot
    return snapshot


def test_the_oracle_s_is_right_and_others_are_wrong(env: Environment) -> None:
    """Nothing is chosen before something is done; a saved episode keeps its choice, and a new one has none."""
    start = env.save()
    assert env.step(np.append(env.physics.arm_qpos(), 1.0)).first_choice is None
    env.restore(start)
    assert chosen(env, env.layout).first_choice is True
    made = env.save()
    others = list(OTHERS[env.task.name](env.task, env.layout))[:2]
    assert others
    for other in others:
        assert env.restore(start).first_choice is None
        assert chosen(env, other).first_choice is False
    assert env.restore(made).first_choice is True


def test_a_later_one_does_not_count(pick_highlight: Environment) -> None:
    """A choice before the button is one; what fails the episode after it is another."""
    pick_highlight.reset(SEED, "hard")
    lit = pick_highlight.layout.targets
    wrong = next(index for index in range(6) if index not in lit)
    motions = Motions(pick_highlight.physics)
    for action in motions.pick(f"cube_{wrong}"):
        snapshot = pick_highlight.step(action)
    assert (snapshot.first_choice, snapshot.status) == (False, Status.ONGOING)
    for motion in (motions.put_down(0.01), motions.pick(f"cube_{lit[0]}")):
        for action in motion:
            snapshot = pick_highlight.step(action)
    assert (snapshot.first_choice, snapshot.status) == (False, Status.ONGOING)
