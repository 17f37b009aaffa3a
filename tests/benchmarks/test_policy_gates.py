"""The gates' table: which are open follows from counts alone, and those not played yet are left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from benchmarks.policy_gates import gates
from dual_system.analysis.counterfactual import SCHEMA


def write_plays(folder: Path, solved: Mapping[str, int], of: int = 20) -> None:
    """``of`` scenes of PickXtimes for each name, the first ``solved`` of them; every other asks for no memory."""
    for name, count in solved.items():
        episodes = [
            {
                "task": "PickXtimes",
                "seed": seed,
                "difficulty": "easy",
                "success": seed < count,
                "ceiling_without_memory": [1, 1 + seed % 2],
            }
            for seed in range(of)
        ]
        (folder / name).mkdir()
        (folder / name / "results.json").write_text(json.dumps({"config": {}, "episodes": episodes}))


def write_heed(folder: Path, heeds: list[float | None]) -> None:
    (folder / "heed_PickXtimes").mkdir()
    pairs = [{"task": "PickXtimes", "score": 0.5, "heed": heed} for heed in heeds]
    found = {"schema": SCHEMA, "models": {}, "pairs": pairs}
    (folder / "heed_PickXtimes" / "counterfactual.json").write_text(json.dumps(found))


def is_open(folder: Path) -> list[tuple[str, bool]]:
    """Each row's numeral, and whether it says open."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in gates(folder).splitlines()[2:]]
    return [(name.split()[0], end == "yes") for name, _, _, end in rows]


def test_nothing_is_said_of_what_was_not_played(tmp_path: Path) -> None:
    assert gates(tmp_path) == ""
    write_plays(tmp_path, {"other_scene": 3})
    assert gates(tmp_path) == ""  # half of what, nobody knows yet


@pytest.mark.parametrize("is_enough", [True, False])
def test_a_gate_opens_at_its_threshold(tmp_path: Path, is_enough: bool) -> None:
    worse = 0 if is_enough else 1
    write_plays(tmp_path, {"grounded": 15 - worse, "simple": 13 - worse})
    assert is_open(tmp_path) == [("(i)", is_enough), ("(i)", is_enough)]


@pytest.mark.parametrize("is_enough", [True, False])
def test_blindness_and_looking_are_measured_against_the_told_hand(tmp_path: Path, is_enough: bool) -> None:
    worse = 0 if is_enough else 1
    write_plays(tmp_path, {"grounded": 20, "other_scene": 10 + worse, "displaced": 14 - worse})
    assert is_open(tmp_path)[1:] == [("(ii)", is_enough), ("(iii)", is_enough)]


def test_a_hand_that_does_nothing_opens_no_gate(tmp_path: Path) -> None:
    write_plays(tmp_path, {"grounded": 0, "simple": 0, "other_scene": 0, "displaced": 0, "alone": 0})
    assert is_open(tmp_path) == [("(i)", False), ("(i)", False), ("(v)", False)]


@pytest.mark.parametrize(("heeds", "expected"), [([0.5, None, 0.5], True), ([0.4, 0.5, None], False)])
def test_heed_is_the_mean_over_pairs_whose_scripts_differ(
    tmp_path: Path, heeds: list[float | None], expected: bool
) -> None:
    write_heed(tmp_path, heeds)
    assert is_open(tmp_path) == [("(iv)", expected)]


@pytest.mark.parametrize(("solved", "expected"), [(12, True), (10, False)])
def test_what_can_be_seen_is_asked_only_in_scenes_that_need_no_memory(
    tmp_path: Path, solved: int, expected: bool
) -> None:
    write_plays(tmp_path, {"alone": solved})
    assert is_open(tmp_path) == [("(v)", expected)]
    assert "10 scenes that need no memory" in gates(tmp_path)
