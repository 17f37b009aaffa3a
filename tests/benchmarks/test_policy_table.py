"""The table of the laptop pair: what was named before the plays decides, from counts alone, what is met."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks.policy_plan import ROWS
from benchmarks.policy_table import LABELS, _holm, _trained_as, table

TASKS = ("VideoUnmask", "PickHighlight", "MoveCube", "PickXtimes")
SCENES = 40


def write_row(folder: Path, name: str, is_solved: Callable[[str, int], bool], ceiling: int = 4) -> None:
    """Plays of the same scenes; a ceiling of 1 in ``ceiling``, and first choices that are right where it solved."""
    episodes = [
        {
            "task": task,
            "seed": seed,
            "difficulty": "easy",
            "success": is_solved(task, seed),
            "ceiling_without_memory": [1, ceiling],
            "first_choice": "right" if is_solved(task, seed) else "wrong",
            "first_choice_tick": 150,
            "first_choice_chance": [1, ceiling],
        }
        for task in TASKS
        for seed in range(SCENES)
    ]
    (folder / "test" / name).mkdir(parents=True)
    (folder / "test" / name / "results.json").write_text(
        json.dumps({"config": {"delay_ms": 300}, "episodes": episodes})
    )


def first(count: int) -> Callable[[str, int], bool]:
    return lambda _, seed: seed < count


def lines_of(text: str, heading: str) -> list[list[str]]:
    part = text.split(f"## {heading}\n\n")[1].split("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines()[2:]]


def test_nothing_is_said_before_a_row_is_played(tmp_path: Path) -> None:
    assert table(tmp_path) == ""


def test_a_row_says_what_it_is(tmp_path: Path) -> None:
    write_row(tmp_path, "laptop_1", first(30))
    (tmp_path / "rows" / "laptop_1" / "ponder").mkdir(parents=True)
    weights = {"a": np.zeros((1000, 500), np.float32), "b": np.zeros(20_000, np.float32)}
    save_file(weights, tmp_path / "rows" / "laptop_1" / "ponder" / "model.safetensors")
    place = [(recipe.__name__, seed) for recipe, seed in ROWS].index(("laptop", 1))
    spent = {"stage": f"rows {place // 2 + 1}", "core_s_by_command": {f"{place % 2}": 1800.0, f"{1 - place % 2}": 9.0}}
    (tmp_path / "hours.jsonl").write_text(f"{json.dumps(spent)}\n{json.dumps(spent)}\n")
    (tmp_path / "cost").mkdir()
    costs = {"ponder_cpu_ms": {"p50": 40.2}, "pounce_cpu_ms": {"p50": 21.4}, "cognition_bytes": 640}
    (tmp_path / "cost" / "laptop.json").write_text(json.dumps(costs))
    (row,) = lines_of(table(tmp_path), "The table")
    name, scenes, success, choice, ceiling, labels, parameters, hours, delay, cost = row
    assert cost == "62, 640"
    assert (name, scenes, ceiling, delay) == ("laptop_1", "4 x 40", "25.0", "300")
    assert success.startswith("75.00 [")
    assert choice.startswith("75.00 [")
    assert (parameters, hours) == ("0.52 M", "1.00")
    assert "A2" in labels


@pytest.mark.parametrize(("solved", "is_control"), [(0, False), (6, True), (10, True), (25, False)])
def test_a_control_is_neither_broken_nor_better_than_luck(tmp_path: Path, solved: int, is_control: bool) -> None:
    """The ceiling is a quarter; told the oracle's words the hand solves nine in ten."""
    write_row(tmp_path, "laptop_text_grounded", first(36))
    write_row(tmp_path, "laptop_observation_0", first(solved))
    write_row(tmp_path, "laptop_0", first(30))
    ((name, _, band, verdict),) = lines_of(table(tmp_path), "Controls")
    assert (name, band) == ("laptop_observation_0", "13.5 to 25.0")
    assert (verdict == "yes") == is_control


def verdicts(folder: Path) -> dict[str, str]:
    rows = lines_of(table(folder), "The two contrasts")
    return {row[0].strip("*"): row[-1] for row in rows if row[1] == "all"}


def test_a_contrast_is_met_by_many_scenes_both_seeds_and_three_tasks(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_row(tmp_path, f"laptop_{seed}", first(30))
        write_row(tmp_path, f"laptop_framesamp_{seed}", first(15))
    write_row(tmp_path, "laptop_current_0", first(14))
    assert verdicts(tmp_path) == {"laptop_framesamp": "met", "laptop_current": "met"}


def test_the_seeds_must_agree(tmp_path: Path) -> None:
    write_row(tmp_path, "laptop_0", first(40))
    write_row(tmp_path, "laptop_1", first(14))
    for seed in (0, 1):
        write_row(tmp_path, f"laptop_framesamp_{seed}", first(15))
    assert verdicts(tmp_path) == {"laptop_framesamp": "**not met**"}


def test_so_must_three_tasks(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_row(tmp_path, f"laptop_{seed}", lambda task, seed: seed < (40 if task in TASKS[:2] else 15))
        write_row(tmp_path, f"laptop_framesamp_{seed}", first(15))
    assert verdicts(tmp_path) == {"laptop_framesamp": "**not met**"}


def test_one_contrast_alone_is_corrected_for_both_that_were_named(tmp_path: Path) -> None:
    """Nine scenes better and none worse: p = 0.0039, which twice is below the level and three times is not."""
    write_row(tmp_path, "laptop_0", lambda task, seed: seed < (3 if task in TASKS[:3] else 0))
    write_row(tmp_path, "laptop_framesamp_0", first(0))
    assert verdicts(tmp_path) == {"laptop_framesamp": "met"}
    assert _holm([0.0039], 2) == [0.0078]


def test_every_row_that_is_trained_says_what_it_was_told() -> None:
    trained = {recipe.__name__ for recipe, _ in ROWS}
    assert all(any(name.startswith(recipe) for name in LABELS) for recipe in trained)
    assert all(_trained_as(name)[0] in trained for name in LABELS)


def test_holm_against_hand_numbers() -> None:
    assert _holm([0.04, 0.01], 2) == [0.04, 0.02]
    assert _holm([0.02, 0.02], 2) == [0.04, 0.04]
    assert _holm([0.9, 0.8], 2) == [1.0, 1.0]


@pytest.mark.parametrize(
    ("name", "trained"),
    [
        ("laptop_0", ("laptop", 0)),
        ("laptop_1_null", ("laptop", 1)),
        ("laptop_framesamp_1", ("laptop_framesamp", 1)),
        ("laptop_text_predicted", ("laptop_text", 0)),
        ("laptop_current_0_retold", ("laptop_current", 0)),
    ],
)
def test_the_name_of_plays_says_what_was_trained(name: str, trained: tuple[str, int]) -> None:
    assert _trained_as(name) == trained
