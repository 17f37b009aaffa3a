"""Jobs: seeds of their own, RoboMME's shares of difficulties and failed grasps."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dual_system.data.jobs import ATTEMPTS, Look, failed_grasp, jobs_of
from dual_system.tasks.seeds import FIRST_COLLECTION_SEED, split_of

JOBS = list(jobs_of(("A", "B"), 900, image_px=256, max_steps=1300, look=Look()))


def test_no_two_attempts_of_a_task_share_a_seed() -> None:
    seeds = [job.seed(attempt) for job in JOBS if job.task == "A" for attempt in range(ATTEMPTS)]
    assert len(set(seeds)) == len(seeds)
    assert {split_of(seed) for seed in seeds} == {"collection"}
    assert min(seeds) == FIRST_COLLECTION_SEED


@given(st.integers(0, 900), st.integers(1, 900))
def test_episodes_from_a_later_one_on_are_those_of_the_whole(first: int, count: int) -> None:
    whole = list(jobs_of(("A", "B"), first + count, image_px=256, max_steps=1300, look=Look()))
    later = list(jobs_of(("A", "B"), count, image_px=256, max_steps=1300, look=Look(), first_slot=first))
    assert later == [job for job in whole if job.slot >= first]


def test_keys_sort_as_jobs_do() -> None:
    keys = [job.key for job in JOBS]
    assert keys == sorted(set(keys))


def test_shares_are_the_benchmark_s() -> None:
    hundred = JOBS[:100]
    assert Counter(job.difficulty for job in hundred) == {"easy": 50, "medium": 25, "hard": 25}
    assert [job.recovery for job in hundred[:7]] == ["z"] * 3 + ["xy"] * 3 + ["none"]
    assert Counter(job.recovery for job in hundred) == {"none": 94, "z": 3, "xy": 3}


def test_difficulties_come_in_turn() -> None:
    turn = ("hard", "easy", "hard")
    jobs = list(jobs_of(("A", "B"), 7, image_px=256, max_steps=1300, look=Look(), difficulties=turn))
    assert [job.difficulty for job in jobs] == [*turn, *turn, "hard"] * 2


def test_a_share_of_failed_grasps_is_split_evenly_and_over_all_difficulties() -> None:
    jobs = list(jobs_of(("A",), 200, image_px=256, max_steps=1300, look=Look(), recovery_share=0.4))
    assert Counter(job.recovery for job in jobs) == {"none": 120, "z": 40, "xy": 40}
    assert Counter(job.difficulty for job in jobs if job.recovery == "z") == {"easy": 20, "medium": 10, "hard": 10}


@given(st.sampled_from(["z", "xy"]), st.integers(0, 2**40), st.integers(1, 9))
def test_one_of_the_grasps_fails_high_or_aside(recovery: str, seed: int, num_grasps: int) -> None:
    fails = failed_grasp(recovery, seed, num_grasps)
    assert fails is not None
    assert fails == failed_grasp(recovery, seed, num_grasps)
    assert 0 <= fails.before < num_grasps
    assert (fails.offset == (0, 0, 1)) == (recovery == "z")
    assert np.any(fails.offset)


def test_every_grasp_and_every_direction_comes_up() -> None:
    found = [failed_grasp("xy", seed, 3) for seed in range(300)]
    assert {fails.before for fails in found if fails} == {0, 1, 2}
    assert len({fails.offset for fails in found if fails}) == 8


def test_there_may_be_nothing_to_fail() -> None:
    assert failed_grasp("z", 1, 0) is None
    assert failed_grasp("none", 1, 3) is None
