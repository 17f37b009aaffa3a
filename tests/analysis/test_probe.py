"""A linear probe finds what is there, nothing where nothing is, and never sees the episode that it predicts."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.analysis.probe import TIME, Instants, probe_table

EPISODES, SECONDS = 30, 8


def instants(**held: np.ndarray) -> Instants:
    """Episodes whose place is drawn anew, and whose second stage begins at a second that is drawn anew."""
    rng = np.random.default_rng(0)
    episode_N, second_N = np.repeat(np.arange(EPISODES), SECONDS), np.tile(np.arange(SECONDS), EPISODES)
    place_N2 = rng.uniform(50, 200, (EPISODES, 2))[episode_N]
    stage_N = 1 + (second_N >= rng.integers(1, SECONDS, EPISODES)[episode_N]).astype(np.int64)
    return Instants(
        episode_N=episode_N,
        second_N=second_N,
        place_N2=place_N2,
        stage_N=stage_N,
        count_N=second_N // 3,
        held=held,
    )


def cells(found: Instants) -> dict[str, list[float]]:
    """By what is probed: mean distance, R2, share of stages and of counts."""
    lines = probe_table({"PickXtimes": found}).splitlines()[2:]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    return {name: [float(each.split()[0]) for each in rest] for _, name, *rest in rows}


def noise(size: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(EPISODES * SECONDS, size))


def test_what_a_vector_holds_is_found_and_what_it_does_not_hold_is_not() -> None:
    wanted = instants()
    mixing = np.random.default_rng(2).normal(size=(3, 20))
    facts_N3 = np.column_stack([wanted.place_N2 / 100, wanted.stage_N])
    found = cells(instants(holds=facts_N3 @ mixing + 0.01 * noise(20), lacks=noise(20)))
    assert found["holds"][0] < 5 < 40 < found["lacks"][0]
    assert found["holds"][1] > 0.99
    assert max(found["lacks"][1], found[TIME][1]) < 0.05
    assert found["holds"][2] > 99
    assert found["lacks"][2] < found[TIME][2] + 5 < 95


def test_what_time_alone_tells_is_no_gain() -> None:
    found = cells(instants(lacks=noise(4)))
    assert found[TIME][3] == 100
    assert found["lacks"][3] == 100


def test_who_knows_the_episode_alone_predicts_none_of_it() -> None:
    """Places are drawn for each episode: with instants of one on both sides, its name would tell them all."""
    names = np.eye(EPISODES)[np.repeat(np.arange(EPISODES), SECONDS)]
    found = cells(instants(names=names))
    assert found["names"][1] < 0.05
    assert found["names"][0] > 40


def test_a_place_that_no_subgoal_names_is_not_scored() -> None:
    found = instants(lacks=noise(4))
    found.place_N2[:] = np.nan
    line = probe_table({"PickXtimes": found}).splitlines()[-1]
    assert line.startswith("| PickXtimes | lacks |  |  | ")


def test_fewer_episodes_than_folds_are_refused() -> None:
    found = instants()
    few = Instants(
        episode_N=found.episode_N % 4,
        second_N=found.second_N,
        place_N2=found.place_N2,
        stage_N=found.stage_N,
        count_N=found.count_N,
        held={},
    )
    with pytest.raises(ValueError, match="PickXtimes: expected at least 5 episodes, one for each fold, came 4"):
        probe_table({"PickXtimes": few})
