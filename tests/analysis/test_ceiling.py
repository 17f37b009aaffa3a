"""Ceilings without memory, against the tasks' own scenes, against counting, and against a player that has none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from fractions import Fraction
from functools import cache
from itertools import combinations, permutations
from math import comb

import numpy as np
import pytest

from dual_system.analysis.ceiling import (
    LAST_DISC_STEP,
    ceiling_in,
    ceiling_of,
    first_choice_in,
    highlight,
    rounds,
    unmask,
)
from dual_system.analysis.memoryless import PLAYERS, play
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.environment import Environment, make_environment
from dual_system.tasks.reference.pick_highlight import HIGHLIGHT_STEPS
from dual_system.tasks.task import make_task

FIRST_SEED = 300_000
"""Of the demo split: no test scene is played for a test."""

EnvironmentOf = Callable[[str], Environment]


@pytest.mark.parametrize(
    ("task", "percent"),
    [
        ("VideoUnmask", 18.24),
        ("PickHighlight", 18.33),
        ("MoveCube", 33.33),
        ("PickXtimes", 34.19),
        ("SwingXtimes", 41.31),
        ("PatternLock", 5.63),
    ],
)
def test_over_the_benchmark_s_mix_they_are(task: str, percent: float) -> None:
    each = [ceiling_of(task, difficulty) for difficulty in DIFFICULTIES]
    assert 100 * float(sum(filter(None, each))) / len(DIFFICULTIES) == pytest.approx(percent, abs=0.005)


def test_pick_x_times_of_two_rounds_or_more_is_154_per_mille() -> None:
    """Easy and medium scenes ask for one to three rounds, hard ones for four or five, all at equal odds."""
    odds = {n: Fraction(2, 9) for n in (2, 3)} | {n: Fraction(1, 6) for n in (4, 5)}
    share = sum(odd * rounds(n) for n, odd in odds.items()) / sum(odds.values())
    assert float(share) == pytest.approx(0.154, abs=0.0005)


@pytest.mark.parametrize("task", [task for task in PLAYERS if task != "VideoUnmask"])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_a_difficulty_s_ceiling_is_the_mean_over_the_scenes_that_are_drawn(task: str, difficulty: str) -> None:
    """Of the values that scenes have, each is equally likely."""
    kind = make_task(task)
    found = {ceiling_in(task, kind.sample(np.random.default_rng(seed), difficulty)) for seed in range(40)}
    assert sum(filter(None, found)) / len(found) == ceiling_of(task, difficulty)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_what_hides_a_cube_is_one_of_so_many_containers(difficulty: str) -> None:
    layout = make_task("VideoUnmask").sample(np.random.default_rng(2), difficulty)
    orders = list(permutations(range(len(layout.containers)), layout.num_picks))
    asked = tuple(cube.container for cube in layout.hidden[: layout.num_picks])
    assert ceiling_in("VideoUnmask", layout) == Fraction(sum(order == asked for order in orders), len(orders))
    assert unmask(9, 2) == Fraction(1, 72)


@pytest.mark.parametrize(("num_cubes", "num_targets"), [(3, 1), (4, 2), (6, 3)])
def test_what_was_lit_is_one_set_of_so_many(num_cubes: int, num_targets: int) -> None:
    """By counting, for whoever picks the first cubes of any order; and for whoever saw the first of them lit."""
    sets = list(combinations(range(num_cubes), num_targets))
    assert highlight(num_cubes, num_targets) == Fraction(1, len(sets))
    assert highlight(num_cubes, num_targets, saw_one=True) == Fraction(1, sum(0 in each for each in sets))


@pytest.mark.parametrize("num_rounds", range(1, 6))
def test_no_odds_of_stopping_are_better(num_rounds: int) -> None:
    """Whoever stops at odds p after every round stops after exactly n at (1 - p)^(n - 1) p."""
    rates = [(1 - Fraction(p, 60)) ** (num_rounds - 1) * Fraction(p, 60) for p in range(61)]  # 60 has 2, 3, 4 and 5
    assert max(rates) == rounds(num_rounds)


def test_the_discs_are_seen_until_then() -> None:
    assert HIGHLIGHT_STEPS[-1] == LAST_DISC_STEP


def test_of_other_tasks_none_is_claimed() -> None:
    assert ceiling_of("StopCube", "easy") is None
    assert ceiling_in("StopCube", object()) is None
    assert first_choice_in("StopCube", object()) is None


@pytest.fixture(scope="module")
def environment_of() -> Iterator[EnvironmentOf]:
    with ExitStack() as stack:
        yield cache(lambda task: stack.enter_context(make_environment(task, render=False)))


def odds_of_so_few(num_hits: int, chances: list[float]) -> tuple[float, float]:
    """The exact odds of at most, and of at least, so many hits of independent trials."""
    exactly = np.array([1.0])
    for chance in chances:
        exactly = np.convolve(exactly, [1 - chance, chance])
    return float(exactly[: num_hits + 1].sum()), float(exactly[num_hits:].sum())


def agree(hits: list[bool], chances: list[Fraction | None]) -> None:
    """The player's hits lie within the central 99 % of what the scenes' chances would give."""
    known = [float(chance) for chance in chances if chance is not None]
    assert len(known) == len(hits)
    assert min(odds_of_so_few(sum(hits), known)) > 0.005


def check_player(environment: Environment, num_scenes: int) -> None:
    """PatternLock's larger grids are left out: hardly anything is guessed right there."""
    difficulty = "easy" if environment.task.name == "PatternLock" else None
    plays = [play(environment, seed, difficulty) for seed in range(FIRST_SEED, FIRST_SEED + num_scenes)]
    assert any(each.is_success for each in plays)
    assert not all(each.is_success for each in plays)
    agree([each.is_success for each in plays], [ceiling_in(environment.task.name, each.layout) for each in plays])
    chose = [each for each in plays if each.first_choice is not None]
    assert len(chose) >= 0.9 * len(plays)
    chances = [first_choice_in(environment.task.name, each.layout) for each in chose]
    agree([bool(each.first_choice) for each in chose], chances)
    assert not any(each.is_success and not each.first_choice for each in plays), "success begins with a right choice"


def test_a_player_without_memory_succeeds_as_often(environment_of: EnvironmentOf) -> None:
    check_player(environment_of("VideoUnmask"), 18)


@pytest.mark.acceptance
@pytest.mark.parametrize("task", PLAYERS)
def test_in_many_scenes_too(environment_of: EnvironmentOf, task: str) -> None:
    check_player(environment_of(task), 200)


def test_who_chose_in_sight_of_the_discs_succeeds_more_often(environment_of: EnvironmentOf) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + 12)
    plays = [play(environment_of("PickHighlight"), seed, saw_one=True) for seed in seeds]
    counts = [(len(each.layout.cubes), len(each.layout.targets)) for each in plays]
    agree([each.is_success for each in plays], [highlight(*each, saw_one=True) for each in counts])
    assert all(each.first_choice for each in plays)
    assert all(each.is_success for each, (_, num_targets) in zip(plays, counts, strict=True) if num_targets == 1)


def test_the_player_takes_each_cube_once_round_the_table(environment_of: EnvironmentOf) -> None:
    """Which k cubes it takes is at the odds of any block of them; only that matters, and that none comes twice."""
    layout = make_task("PickHighlight").sample(np.random.default_rng(1), "hard")
    texts = []
    for seed in range(20):
        acts = PLAYERS["PickHighlight"](make_task("PickHighlight"), layout, np.random.default_rng(seed))
        grounds = [act.grounds for act in acts if act.text.startswith("pick")]
        assert len(set(grounds)) == len(grounds) == 3
        texts.append(frozenset(grounds))
    assert 1 < len(set(texts)) <= comb(6, 3)
