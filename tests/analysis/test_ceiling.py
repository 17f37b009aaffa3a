"""The no-memory ceiling against a player who guesses, and against the task's own numbers of cubes and targets."""

from __future__ import annotations

from fractions import Fraction
from itertools import permutations

import numpy as np
import pytest

from dual_system.analysis.ceiling import NUM_CUBES_AND_TARGETS, ceiling_of, pick_highlight_ceiling
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.task import make_task


def test_over_the_benchmark_s_mix_it_is_eleven_sixtieths() -> None:
    assert pick_highlight_ceiling(DIFFICULTIES[seed % 3] for seed in range(300)) == Fraction(11, 60)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_it_is_the_share_of_orders_that_begin_with_the_targets(difficulty: str) -> None:
    """By counting: a player without memory picks the cubes in some order, and all orders are alike to it."""
    num_cubes, num_targets = NUM_CUBES_AND_TARGETS[difficulty]
    orders = list(permutations(range(num_cubes)))
    won = sum(set(order[:num_targets]) == set(range(num_targets)) for order in orders)
    assert pick_highlight_ceiling([difficulty]) == Fraction(won, len(orders))


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_the_numbers_are_the_task_s(difficulty: str) -> None:
    layout = make_task("PickHighlight").sample(np.random.default_rng(0), difficulty)
    assert (len(layout.cubes), len(layout.targets)) == NUM_CUBES_AND_TARGETS[difficulty]


def test_of_other_tasks_none_is_claimed() -> None:
    assert ceiling_of("StopCube", ["easy"]) is None
    with pytest.raises(ValueError, match="no episodes"):
        pick_highlight_ceiling([])
