"""What `pp-tables` says of the kitchen: success, and which goal of a set was done where only what is shown tells it.

Scenes without a demonstration are left out of every condition, as the benchmark leaves out unusable pairs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.results import RESULTS, ResultsError
from dual_system.analysis.statistics import bootstrap, wilson
from protocol import files

ABOUT = """\
Success in per cent with 95 % intervals: of a task Wilson's over its scenes, of means a task-stratified bootstrap.
`own` is the goal that a scene's seed draws, its twin what `--pictures retold` shows instead; they are counts of
episodes in which that goal was done. A guess among the goals succeeds in `chance` per cent."""

_UNPAIRED = "unpaired"
_KIND = "results file of pp-eval or sim-client"


@dataclass(frozen=True, slots=True, kw_only=True)
class KitchenResults:
    """One condition in the kitchen: by task, by scene, the lines of its runs."""

    label: str
    config: Mapping[str, Any]
    lines: Mapping[str, Mapping[int, Sequence[Mapping[str, Any]]]]
    is_untrained: bool


def is_kitchen(path: Path) -> bool:
    """Returns whether a results file is of the kitchen's tasks."""
    found = files.read_json(_file(path), _KIND)
    with files.reading(_file(path), _KIND):
        return any("goals" in episode for episode in found["episodes"])


def read_kitchen(path: Path) -> KitchenResults:
    """Reads a results file, or that of a folder.

    Raises:
        OSError, FileError: the file cannot be read, or is no results file.
        ResultsError: a scene that was not played in every run, as in an unfinished evaluation.
    """
    found, lines = files.read_json(_file(path), _KIND), dict[str, dict[int, list[dict[str, Any]]]]()
    with files.reading(_file(path), _KIND):
        for line in found["episodes"]:
            lines.setdefault(line["task"], {}).setdefault(int(line["seed"]), []).append(line)
        runs = {line.get("run", 0) for line in found["episodes"]}
        models = [model for line in found["episodes"] for model in line.get("models", {}).values()]
        for task, scenes in lines.items():
            for seed, played in scenes.items():
                if {line.get("run", 0) for line in played} != runs or len(played) != len(runs):
                    raise ResultsError(
                        f"{path}: {task} seed {seed} was not played once in each run; start the same pp-eval again"
                    )
        return KitchenResults(
            label=str(path.parent if path.name == RESULTS else path),
            config=dict(found["config"]),
            lines=lines,
            is_untrained=any(model["is_untrained"] for model in models),
        )


def kitchen_tables(results: Sequence[KitchenResults]) -> str:
    """Returns the tables of conditions over the same scenes. Raises ResultsError if they are not the same."""
    first = results[0]
    for each in results[1:]:
        if {task: set(of) for task, of in each.lines.items()} != {task: set(of) for task, of in first.lines.items()}:
            raise ResultsError(f"{each.label} has other tasks or scenes than {first.label}; make tables of each")
    rows = [_row(task, each, _paired(task, results)) for task in first.lines for each in results]
    means = [[each.label, percent(bootstrap(outcomes))] for each in results if (outcomes := _outcomes(each, results))]
    untrained = [
        f"- `{each.label}`: **untrained weights: motion, not skill.**" for each in results if each.is_untrained
    ]
    head = ["task", "condition", "shown", "scenes", "success, %", "chance, %", "own", "twin", "another", "none"]
    parts = ["# Kitchen", ABOUT, *untrained, markdown(head, rows)]
    return "\n\n".join([*parts, markdown(["mean of the tasks", "success, %"], means)])


def _row(task: str, results: KitchenResults, seeds: Sequence[int]) -> list[str]:
    shown = str(results.config.get("pictures", "own"))
    of = f"{len(seeds)} of {len(results.lines[task])}"
    if not seeds:
        return [task, results.label, shown, of, *[""] * 6]
    played = [line for seed in seeds for line in results.lines[task][seed]]
    rate = float(np.mean([line["success"] for line in played]))
    num_goals = int(played[0]["goals"]["of"])
    counts: list[str] = [""] * 4
    if num_goals > 1:
        done = Counter(_whose(line["goals"]) for line in played)
        counts = [str(done[name]) for name in ("own", "twin", "another", "none")]
    chance = f"{100 / num_goals:.1f}" if num_goals > 1 else ""
    return [task, results.label, shown, of, percent(wilson(rate, len(seeds))), chance, *counts]


def _whose(goals: Mapping[str, Any]) -> str:
    if goals["done"] is None:
        return "none"
    return next((name for name in ("own", "twin") if goals["done"] == goals[name]), "another")


def _paired(task: str, results: Sequence[KitchenResults]) -> list[int]:
    """The seeds that have a demonstration in every condition."""
    return [
        seed
        for seed in sorted(results[0].lines[task])
        if not any(_UNPAIRED in line for each in results for line in each.lines[task][seed])
    ]


def _outcomes(results: KitchenResults, all_results: Sequence[KitchenResults]) -> list[NDArray[np.int64]]:
    found = []
    for task, scenes in results.lines.items():
        if seeds := _paired(task, all_results):
            by_run = [sorted(scenes[seed], key=lambda line: line.get("run", 0)) for seed in seeds]
            found.append(np.array([[int(line["success"]) for line in runs] for runs in by_run]).T)
    return found


def _file(path: Path) -> Path:
    return path / RESULTS if path.is_dir() else path
