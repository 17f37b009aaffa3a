"""Kitchens that show another demonstration, or none: start and physics stay the seed's own."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from dual_system.tasks.kitchen.disguises import KINDS, LastFrame, Retold, WithoutCue
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS, drawn_goal, twin_of
from dual_system.tasks.task import TaskError


@pytest.mark.parametrize("name", GOAL_SETS)
def test_each_goal_is_the_twin_of_one_other(name: str) -> None:
    k = len(GOAL_SETS[name].choices)
    pairs = Counter((drawn_goal(name, seed), twin_of(name, seed)) for seed in range(200))
    assert len(pairs) == k
    assert {own for own, _ in pairs} == {twin for _, twin in pairs} == set(range(k))
    assert all(own != twin for own, twin in pairs)


def test_the_twin_is_shown_and_judged_in_the_seeds_own_start() -> None:
    with (
        KitchenEnvironment("PressOrServe", render=False) as own,
        Retold("PressOrServe", render=False) as retold,
    ):
        starts = [each.reset(3).state for each in (own, retold)]
        np.testing.assert_array_equal(*starts)
        assert own.scene.plan == retold.scene.plan
        assert own.scene.goal == own.own_goal == retold.own_goal
        assert retold.scene.goal == twin_of("PressOrServe", 3) != own.scene.goal
        assert own.instruction == retold.instruction
        with pytest.raises(TaskError, match="OpenDrawer has one goal, so nothing can be retold"):
            Retold("OpenDrawer", render=False).reset(0)


def test_less_is_shown_of_the_same_demonstration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KitchenEnvironment, "demonstration", lambda self, rate_hz, look_hz: iter(range(rate_hz)))
    assert list(LastFrame("OpenDrawer", render=False).demonstration(20, look_hz=1)) == [19]
    assert [kind for kind in KINDS.values() if not kind.has_demonstration] == [WithoutCue]
