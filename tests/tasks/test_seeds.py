"""Splits of seeds: every seed has one, the ranges are those of the protocol, and held-out ones are refused by name."""

from __future__ import annotations

from collections import Counter
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.tasks.seeds import (
    FIRST_COLLECTION_SEED,
    UNTRAINED,
    SeedError,
    Split,
    require_open,
    scenes,
    seeds_from,
    split_of,
)

RANGES: dict[str, list[range]] = {
    "development": [range(500_000, 800_000)],
    "test": [range(800_000, 800_100)],
    "reserved": [range(810_000, 810_100), range(820_000, 820_100)],
    "rollouts": [range(1_000_000, 2_000_000)],
    "collection": [range(2_000_000, 2**63)],
}
"""The protocol, written down once more; all else is for demos."""
EDGES = [
    edge + d for of in RANGES.values() for r in of for edge in (r[0], r[-1]) for d in (-1, 0, 1) if edge + d < 2**63
]

any_seed = st.integers(0, 2**63 - 1) | st.sampled_from(EDGES) | st.integers(0, 2_100_000)


@given(any_seed)
def test_every_seed_has_one_split_and_it_is_the_protocol_s(seed: int) -> None:
    holders = [name for name, of in RANGES.items() if any(seed in each for each in of)]
    assert len(holders) <= 1
    assert split_of(seed) == (holders or ["demo"])[0]


def test_no_range_of_the_protocol_is_missing() -> None:
    found = Counter(split_of(seed) for seed in range(2_000_001))
    sizes = {name: sum(len(each) for each in of) for name, of in RANGES.items() if name != "collection"}
    assert found == {**sizes, "collection": 1, "demo": 2_000_000 - sum(sizes.values())}
    assert set(found) == set(get_args(Split))
    assert FIRST_COLLECTION_SEED == 2_000_000


@given(any_seed)
def test_seeds_that_follow_are_of_the_same_split_and_end_where_another_begins(seed: int) -> None:
    room = seeds_from(seed)
    assert room[0] == seed
    assert split_of(room[-1]) == split_of(seed)
    assert room.stop == 2**63 or split_of(room.stop) != split_of(seed)


@given(num=st.integers(1, 200), seed=st.none() | any_seed, split=st.none() | st.sampled_from(get_args(Split)))
def test_scenes_are_of_the_split_that_was_named_or_are_refused(num: int, seed: int | None, split: Split | None) -> None:
    try:
        found = scenes(num, split=split, seed=seed)
    except SeedError:
        return
    assert len(found) == num
    assert seed is None or found[0] == seed
    (there,) = {split_of(each) for each in found}
    assert there == split or (split is None and there not in ("test", "reserved", "collection"))
    assert there not in ("reserved", "collection")


@pytest.mark.parametrize(("split", "first"), [("demo", 0), ("development", 500_000), ("test", 800_000)])
def test_a_split_alone_begins_at_its_first_seed(split: Split, first: int) -> None:
    assert scenes(50, split=split) == range(first, first + 50)
    assert scenes(50) == range(50)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"num_scenes": 1, "seed": 800_099}, "only if it is named .*--split test"),
        ({"num_scenes": 101, "split": "test"}, "leave the test split.*at most 100 scenes"),
        ({"num_scenes": 2, "seed": 799_999}, "leave the development split"),
        ({"num_scenes": 1, "seed": 810_000}, "kept for later"),
        ({"num_scenes": 1, "split": "reserved"}, "kept for later"),
        ({"num_scenes": 1, "seed": 2_000_000}, "the training data's"),
        ({"num_scenes": 1, "split": "development", "seed": 3}, "of the demo split, not of development.*500000"),
        ({"num_scenes": 1, "seed": -1}, "at least 0"),
    ],
)
def test_a_refusal_names_the_split_and_the_way_out(asked: dict[str, object], sentence: str) -> None:
    with pytest.raises(SeedError, match=sentence):
        scenes(**asked)


@given(any_seed)
def test_only_held_out_scenes_are_closed(seed: int) -> None:
    if split_of(seed) in ("test", "reserved"):
        assert split_of(seed) in UNTRAINED
        with pytest.raises(SeedError, match="take another"):
            require_open(seed, "take another")
    else:
        require_open(seed, "take another")
