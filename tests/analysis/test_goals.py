"""The kitchen's tables follow from results files alone: which goal was done, over scenes that all conditions share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dual_system.analysis import tables
from dual_system.analysis.goals import is_kitchen, kitchen_tables, read_kitchen
from dual_system.analysis.results import ResultsError

GOALS = {"own": 1, "twin": 2, "of": 4}
DONE = {"own": 1, "twin": 2, "another": 0, "none": None}


def write(folder: Path, runs: list[list[str]], *, task: str = "FourKnobs", **config: Any) -> Path:
    """Results of runs over scenes; each says whose goal was done, or that there was no demonstration."""
    asked = "twin" if config.get("pictures") == "retold" else "own"
    episodes = [
        {"task": task, "run": run, "seed": seed, "difficulty": "", "success": whose == asked,
         "goals": GOALS | {"done": DONE.get(whose)}} | ({"unpaired": "no way"} if whose == "unpaired" else {})
        for run, scenes in enumerate(runs)
        for seed, whose in enumerate(scenes)
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps({"config": config, "episodes": episodes}))
    return folder


def test_the_goal_that_was_done_is_counted_by_whose_it_is(tmp_path: Path) -> None:
    own = write(tmp_path / "own", [["own", "own", "twin", "another"], ["own", "none", "none", "none"]])
    twin = write(tmp_path / "retold", [["twin", "twin", "twin", "own"]], pictures="retold")
    found = kitchen_tables([read_kitchen(own), read_kitchen(twin)])
    assert f"| FourKnobs | {own} | own | 4 of 4 | 37.50 [9.2, 78.1] | 25.0 | 3 | 1 | 1 | 3 |" in found
    assert f"| FourKnobs | {twin} | retold | 4 of 4 | 75.00 [30.1, 95.4] | 25.0 | 1 | 3 | 0 | 0 |" in found
    assert f"| {twin} | 75.00" in found


def test_a_scene_without_a_demonstration_is_left_out_of_every_condition(tmp_path: Path) -> None:
    own = write(tmp_path / "own", [["own", "none", "own", "none"]])
    twin = write(tmp_path / "retold", [["twin", "unpaired", "none", "none"]], pictures="retold")
    found = kitchen_tables([read_kitchen(own), read_kitchen(twin)])
    assert f"{own} | own | 3 of 4 | 66.67" in found
    assert f"{twin} | retold | 3 of 4 | 33.33" in found
    alone = kitchen_tables([read_kitchen(own)])
    assert "4 of 4 | 50.00" in alone
    nothing = write(tmp_path / "nothing", [["unpaired"]])
    assert "| 0 of 1 |  |" in kitchen_tables([read_kitchen(nothing)])


def test_conditions_over_other_scenes_and_unfinished_ones_are_refused(tmp_path: Path) -> None:
    few, many = (read_kitchen(write(tmp_path / str(n), [["own"] * n])) for n in (2, 3))
    with pytest.raises(ResultsError, match="other tasks or scenes"):
        kitchen_tables([few, many])
    with pytest.raises(ResultsError, match="seed 1 was not played once in each run"):
        read_kitchen(write(tmp_path / "unfinished", [["own", "own"], ["own"]]))


def test_one_command_makes_the_tables(tmp_path: Path) -> None:
    folder = write(tmp_path / "own", [["own", "none"]])
    assert is_kitchen(folder)
    assert tables.main([str(folder), "--out", str(tmp_path / "made")]) == 0
    assert "| FourKnobs | " in (tmp_path / "made" / "tables.md").read_text()
