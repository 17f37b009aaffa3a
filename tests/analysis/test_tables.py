"""Tables follow from results files alone: a made-up one against the text written out; and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dual_system.analysis import paper
from dual_system.analysis.results import ResultsError, read_comparable, read_results
from dual_system.analysis.tables import between_conditions, by_family, by_task, main, tables
from dual_system.tasks.task import make_task, task_names

CONFIG = {"mode": "lockstep", "max_steps": 1300, "deliver": "every", "query_period_ms": 1000, "delay_ms": 300}


def write(folder: Path, successes: dict[str, list[str]], **config: Any) -> Path:
    """Results of runs such as "0110": a digit a scene."""
    episodes = [
        {"task": task, "run": run, "seed": seed, "difficulty": "easy", "success": digit == "1"}
        for task, runs in successes.items()
        for run, digits in enumerate(runs)
        for seed, digit in enumerate(digits)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps({"config": CONFIG | config, "episodes": episodes}))
    return folder


REAL = {"StopCube": ["1111", "1111"], "BinFill": ["0000", "0000"], "VideoUnmask": ["1111", "1111"]}
NULL = {"StopCube": ["0000"], "BinFill": ["0000"], "VideoUnmask": ["1111"]}


@pytest.fixture
def conditions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Real cognition and none, on four scenes of three tasks; extreme, so that every number can be said by hand."""
    monkeypatch.chdir(tmp_path)
    write(Path("real"), REAL)
    write(Path("null"), NULL, deliver="null")
    return Path("real"), Path("null")


MARK = "(paper, another simulator)"
METHODS = "π0.5 1×|MemER 1×|FrameSamp+Modul 1×|PonderPounce 1×|FrameSamp+Modul 9×|PonderPounce 9×"
PAPERS = " | ".join(f"{method} {MARK}" for method in METHODS.split("|"))
RULE = "--- | --: | --: | --: | --: | --: | --: | --: | --:"

BY_FAMILY = f"""\
| family | real | null | {PAPERS} |
| {RULE} |
| Counting (2 of 4 tasks) | 50.00 [50.0, 50.0] | 0.00 [0.0, 0.0] | 18.34 | 28.34 | 40.78 | 66.67 | 75.00 | 67.00 |
| Permanence (1 of 4 tasks) | 100.00 [100.0, 100.0] | 100.00 [100.0, 100.0] | 20.44 | 81.33 | 32.67 | 94.67 | 28.00 | 96.67 |
| **Average** of 3 tasks | 66.67 [66.7, 66.7] | 33.33 [33.3, 33.3] | 19.04 | 46.00 | 38.08 | 76.00 | 59.33 | 76.89 |"""  # noqa: E501

BY_TASK = f"""\
| task | real | null | {PAPERS} |
| {RULE} |
| BinFill | 0.00 [0.0, 49.0] | 0.00 [0.0, 49.0] | 30.00 | 56.67 | 39.56 | 50.67 | 74.00 | 74.00 |
| StopCube | 100.00 [51.0, 100.0] | 0.00 [0.0, 49.0] | 6.67 | 0.00 | 42.00 | 82.67 | 76.00 | 60.00 |
| VideoUnmask | 100.00 [51.0, 100.0] | 100.00 [51.0, 100.0] | 20.44 | 81.33 | 32.67 | 94.67 | 28.00 | 96.67 |"""

CONDITIONS = """\
| condition | POUNCE gets | refresh | delay | K | Counting | Permanence | Average | minus the first | scenes better, worse | sign test p |
| --- | --: | --: | --: | --: | --: | --: | --: | --: | --: | --: |
| real | C_t | 1000 ms | 300 ms |  | 50.00 [50.0, 50.0] | 100.00 [100.0, 100.0] | 66.67 [66.7, 66.7] |  |  |  |
| null | the null cognition | 1000 ms | 300 ms |  | 0.00 [0.0, 0.0] | 100.00 [100.0, 100.0] | 33.33 [33.3, 33.3] | -33.33 [-33.3, -33.3] | 0, 4 | 0.12 |"""  # noqa: E501


CHOSEN = {
    "PickHighlight": [("right", 140, 90, [1, 3]), ("wrong", 200, 120, [1, 2]), ("wrong", 80, None, [1, 3]),
                      ("right", 80, 99, [1, 3]), *[(None, None, None, [1, n]) for n in (3, 2, 3, 3)]],
    "MoveCube": [("right", 50, None, [1, 3]), ("wrong", 50, None, [1, 3]), (None, None, None, [1, 3]),
                 ("right", 50, None, [1, 3]), ("right", 50, None, [1, 3]), *[(None, None, None, [1, 3])] * 3],
    "PickXtimes": [(None, None, 30, [1, 4])] * 4,
}  # fmt: skip
"""Of each episode: choice, its tick, the tick of the button, and the chance."""

FIRST_CHOICES = """\
| task | condition | committed | right | right, % | chance, % |
| --- | --: | --: | --: | --: | --: |
| PickXtimes | FOLDER | 0 of 4 | 0 |  |  |
| PickHighlight, button pressed first | FOLDER | 1 of 8 | 0 | 0.00 [0.0, 79.3] | 50.00 |
| PickHighlight, button pressed by step 100, discs in sight | FOLDER | 1 of 8 | 1 | 100.00 [20.7, 100.0] | 100.00 |
| PickHighlight, chosen before the button | FOLDER | 2 of 8 | 1 | 50.00 [9.5, 90.5] |  |
| MoveCube | FOLDER | 4 of 8 | 3 | 75.00 [25.6, 96.3] | 33.33 |"""


def test_the_tables_of_a_made_up_evaluation(conditions: tuple[Path, Path]) -> None:
    results = read_comparable(conditions)
    assert by_family(results) == BY_FAMILY
    assert by_task(results) == BY_TASK
    assert between_conditions(results) == CONDITIONS


def test_one_command_writes_all_of_them(conditions: tuple[Path, Path], tmp_path: Path) -> None:
    assert main([*map(str, conditions), "--out", str(tmp_path / "made")]) == 0
    text = (tmp_path / "made" / "tables.md").read_text()
    assert text == tables(read_comparable([path / "results.json" for path in conditions]))
    assert BY_FAMILY in text
    assert "- `real`: 3 tasks, 12 scenes, 2 runs; lockstep, at most 1300 steps.\n" in text
    assert "no baseline of ours" in text


def test_of_all_sixteen_tasks_the_paper_s_interventions_stand_below(tmp_path: Path) -> None:
    every = {task: ["01"] for task in paper.TASKS}
    results = read_comparable([write(tmp_path / name, every) for name in ("a", "b")])
    last = between_conditions(results).splitlines()[-1]
    assert last.startswith(f"| Table 4: transitions only, age reported as 300 ms {MARK} |")
    assert "| 0.17 | 0.17 | 0.67 | 6.33 | 1.83 |" in last


@pytest.mark.parametrize(
    ("config", "told"),
    [
        ({}, "C_t"),
        ({"deliver": "held-transition", "held_age_ms": 300}, "C_t held at transitions, with age 300 ms"),
        ({"deliver": "held-transition"}, "C_t held at transitions, with its true age"),
        ({"cognition": "other-episode"}, "another episode's cognition"),
        ({"policy": "oracle"}, "nothing: the oracle played"),
        ({"subgoal_text": "ponder"}, "PONDER's subgoal text"),
        ({"subgoal_text": "simple"}, "the task's subgoal without places"),
    ],
)
def test_a_condition_says_what_pounce_got(tmp_path: Path, config: dict[str, Any], told: str) -> None:
    results = [read_results(write(tmp_path / "a", REAL, **config)), read_results(write(tmp_path / "b", REAL))]
    assert f" | {told} | " in between_conditions(results).splitlines()[2]


def test_untrained_weights_are_named(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", {"StopCube": ["0"]})
    found = json.loads((folder / "results.json").read_text())
    model = {"model_hash": "x", "num_carriers": 2, "is_untrained": True}
    found["episodes"][0]["models"] = {"ponder": model, "pounce": model}
    (folder / "results.json").write_text(json.dumps(found))
    results = read_results(folder)
    assert results.num_carriers == 2
    assert "**Untrained weights: motion, not skill.**" in tables([results])


@pytest.mark.parametrize(
    ("episodes", "words"),
    [
        ({"StopCube": ["01", "0"]}, "1 episodes are missing, the first is StopCube seed 1 of run 1"),
        ({"StopCube": ["01"], "BinFill": ["01", "01"]}, "2 episodes are missing"),
        ({"Juggle": ["01"]}, "Juggle"),
        ({}, "no episode is finished"),
    ],
)
def test_results_that_cannot_be_counted_are_refused(tmp_path: Path, episodes: Any, words: str) -> None:
    with pytest.raises(ResultsError, match=words):
        read_results(write(tmp_path, episodes))


def test_a_scene_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path, {"StopCube": ["01"]})
    found = json.loads((folder / "results.json").read_text())
    found["episodes"] *= 2
    (folder / "results.json").write_text(json.dumps(found))
    with pytest.raises(ResultsError, match="2 times"):
        read_results(folder)


def test_what_is_no_results_file_is_told_as_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text("[]")
    for path in (tmp_path / "x.json", tmp_path / "absent"):
        assert main([str(path), "--out", str(tmp_path / "made")]) == 2
        assert str(path) in capsys.readouterr().err
    assert not (tmp_path / "made").exists()


def test_other_tasks_and_other_scenes_are_not_set_side_by_side(tmp_path: Path) -> None:
    one = write(tmp_path / "one", {"StopCube": ["01"]})
    with pytest.raises(ResultsError, match="other tasks"):
        read_comparable([one, write(tmp_path / "two", {"BinFill": ["01"]})])
    with pytest.raises(ResultsError, match="twice"):
        read_comparable([one, one])
    with pytest.raises(ResultsError, match="not run on the scenes"):
        tables(read_comparable([one, write(tmp_path / "three", {"StopCube": ["011"]})]))


# -- the paper's figures


@pytest.mark.parametrize("method", paper.TABLE_7)
def test_table_7_averages_to_table_1(method: str) -> None:
    means = [paper.mean_of(method, tasks) for tasks in (*paper.FAMILIES.values(), paper.TASKS)]
    assert means == pytest.approx(paper.TABLE_1[method], abs=0.02)


@pytest.mark.parametrize("table", [paper.TABLE_3, paper.TABLE_4])
def test_rows_of_the_other_tables_average_too(table: dict[str, tuple[float, ...]]) -> None:
    for *families, average in table.values():
        assert sum(families) / 4 == pytest.approx(average, abs=0.01)


def test_the_reported_checkpoint_is_the_same_row_in_every_table() -> None:
    ours = paper.TABLE_1["PonderPounce 1×"]
    assert ours == paper.TABLE_3["continuous cognition"] == paper.TABLE_4["every query"]
    assert set(paper.SHOWN) <= paper.TABLE_7.keys() == paper.TABLE_1.keys()


def test_families_are_those_of_the_tasks() -> None:
    for family, tasks in paper.FAMILIES.items():
        assert {make_task(task).family for task in tasks} == {family}
    assert set(paper.TASKS) <= set(task_names())


def test_ceilings_are_of_the_scenes_that_were_played_and_of_those_that_need_memory(tmp_path: Path) -> None:
    """As recorded; of an older file, or another simulator's scenes, what the difficulty gives."""
    folder = write(tmp_path / "a", {"PickXtimes": ["0101"]})
    assert f"exactly: {100 * 151 / 324:.2f} over the scenes of `{folder}`. Without" in tables([read_results(folder)])
    found = json.loads((folder / "results.json").read_text())
    for episode, ceiling in zip(found["episodes"], ([1, 1], [1, 4], [4, 27], [1, 1]), strict=True):
        episode["ceiling_without_memory"] = ceiling
    (folder / "results.json").write_text(json.dumps(found))
    mean, hard = (2 + 1 / 4 + 4 / 27) / 4, (1 / 4 + 4 / 27) / 2
    text = tables([read_results(folder)])
    assert (
        f"{100 * mean:.2f} over the scenes of `{folder}` ({100 * hard:.2f} over the 2 that need memory). Without"
        in text
    )


def test_first_choices_are_of_the_episodes_that_committed(tmp_path: Path) -> None:
    """With the chance of the same episodes; PickHighlight's apart by what the player could see."""
    folder = write(
        tmp_path / "a", {"PickHighlight": ["1000", "0000"], "MoveCube": ["1100", "0000"], "PickXtimes": ["00", "00"]}
    )
    assert "First choice" not in tables([read_results(folder)]), "of an earlier release"
    found = json.loads((folder / "results.json").read_text())
    of_task = {task: iter(cells) for task, cells in CHOSEN.items()}
    for episode in found["episodes"]:
        choice, tick, pressed, chance = next(of_task[episode["task"]])
        episode |= {"first_choice": choice, "first_choice_tick": tick, "first_done_tick": pressed}
        episode["first_choice_chance"] = chance
    (folder / "results.json").write_text(json.dumps(found))
    assert FIRST_CHOICES.replace("FOLDER", str(folder)) in tables([read_results(folder)])


def test_choices_are_counted_by_the_time_since_the_cue_was_in_sight(tmp_path: Path) -> None:
    """Beside the discs nothing is remembered yet; a count has no cue that goes."""
    folder = write(tmp_path / "a", {"PickHighlight": ["11010"], "MoveCube": ["10"], "PickXtimes": ["1"]})
    found = json.loads((folder / "results.json").read_text())
    lit = [("right", 99), ("right", 179), ("wrong", 180), ("right", 420), (None, None)]
    choices = iter([*lit, ("right", 0), ("wrong", 79), ("right", 50)])
    for episode in found["episodes"]:
        episode["first_choice"], episode["first_choice_tick"] = next(choices)
    (folder / "results.json").write_text(json.dumps(found))
    text = tables([read_results(folder)])
    section = text[text.index("## By the time since") :].split("\n\n")[2].splitlines()
    assert section[0] == "| task | condition | 0 to 4 s | 4 to 8 s | 8 to 16 s | from 16 s |"
    assert section[2:] == [
        f"| PickHighlight | {folder} | 1, 1 of 1 | 0, 0 of 1 |  | 1, 1 of 1 |",
        f"| MoveCube | {folder} | 1, 1 of 2 |  |  |  |",
    ]


def write_choices(folder: Path, choices: list[str | None], **config: Any) -> Path:
    """Results of MoveCube in which these were the first choices."""
    write(folder, {"MoveCube": ["0" * len(choices)]}, **config)
    found = json.loads((folder / "results.json").read_text())
    for episode, choice in zip(found["episodes"], choices, strict=True):
        episode |= {"first_choice": choice, "first_choice_tick": 5}
    (folder / "results.json").write_text(json.dumps(found))
    return folder


def test_a_channel_s_delays_stand_in_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    played: dict[str, dict[str, Any]] = {
        "C_0": {},
        "C_2000": {"delay_ms": 2000},
        "told": {"delay_ms": 2000, "held_age_ms": 300},
    }
    for place, (name, changes) in enumerate(played.items()):
        write(
            Path(name),
            {"StopCube": ["1" * (3 - place) + "0" * (1 + place)]},
            pounce_checkpoint="rows/pair_0/pounce",
            **changes,
        )
    write(Path("once"), {"StopCube": ["1111"]}, pounce_checkpoint="rows/other_0/pounce")
    assert main([*played, "once", "--out", "."]) == 0
    text = Path("tables.md").read_text()
    curves = text[text.index("## By delay") :].split("## ")[1].splitlines()
    head, _, row, told = [line for line in curves if line.startswith("| ")]
    assert head == "| POUNCE gets | 0.3 s | 2 s |"
    assert row.startswith("| pair_0: C_t | 75.00 [")
    assert "| 50.00 [" in row
    assert told.startswith("| pair_0: C_t, told as 300 ms old |  | 25.00 [")
    assert main(["once", "--out", "."]) == 0
    assert "By delay" not in Path("tables.md").read_text()


def test_two_pasts_of_one_present_are_counted_scene_by_scene(tmp_path: Path) -> None:
    """A condition is the same whatever was recorded of it, and whichever other tasks it was played in."""
    own = write_choices(tmp_path / "own", ["right", "right", "wrong", "wrong", None], record=True)
    add_task(own, "PickXtimes")
    other = write_choices(tmp_path / "other", ["right", "wrong", "right", "wrong", "right"], pictures="retold")
    late = write_choices(tmp_path / "late", ["right"] * 5, pictures="retold", delay_ms=1000)
    assert main([str(own), str(other), str(late), "--out", str(tmp_path)]) == 0
    text = (tmp_path / "tables.md").read_text()
    assert text.count(f"| MoveCube | {own} | 4 of 5 | 1 | 2 | 1 | 25.00 [4.6, 69.9] |") == 1
    assert f"{other}" not in text, "it is judged otherwise, and stands in no other table"
    assert main([str(own), "--out", str(tmp_path)]) == 0
    assert "another past" not in (tmp_path / "tables.md").read_text()


def add_task(folder: Path, task: str) -> None:
    found = json.loads((folder / "results.json").read_text())
    found["episodes"] += [episode | {"task": task} for episode in found["episodes"]]
    (folder / "results.json").write_text(json.dumps(found))


def test_who_could_choose_in_sight_of_the_discs_is_listed_apart(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", {"PickHighlight": ["11010"]})
    assert "was pressed" not in tables([read_results(folder)])
    found = json.loads((folder / "results.json").read_text())
    for episode, tick, difficulty in zip(
        found["episodes"], (95, 100, 101, 130, None), ("easy", "medium", "easy", "hard", "easy"), strict=True
    ):
        episode |= {"first_done_tick": tick, "difficulty": difficulty}
    (folder / "results.json").write_text(json.dumps(found))
    assert (
        f"Of the episodes of `{folder}` the button was pressed by step 100, with the discs still in sight, in 2 "
        "(2 solved, ceiling 66.67 %); later in 2 (1 solved, ceiling 19.17 %); never in 1 (0 solved)."
    ) in tables([read_results(folder)])
