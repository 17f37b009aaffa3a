"""Reads ``results.json`` of ``sim-client`` and ``pp-eval`` into arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis import paper
from dual_system.analysis.ceiling import ceiling_of
from protocol import files
from protocol.errors import CommandError

Scene = tuple[int, str]  # seed and difficulty, which determine a task's scene
RESULTS = "results.json"
_CHOICES = {"right": 1, "wrong": 0, None: -1}


class ResultsError(CommandError):
    """A results file that cannot be used; the message says what was expected, what was found, and the way out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Results:
    """One condition: the same scenes in one or several runs.

    Attributes:
        label: the folder as given.
        config: the evaluation's options.
        outcomes: per task, in the paper's order, (R, E): 1 where the episode succeeded.
        scenes: per task, the E scenes in ascending order.
        ceilings: per task, of the E scenes: the ceiling without memory as recorded, else its mean over the difficulty's
            scenes; None if none is known.
        first_done: per task, (R, E): the tick at which the first subtask was done; -1 if never, or not recorded.
        first_choices: per task, (R, E): 1 where the first choice was right, 0 where it was wrong, -1 where there was
            none or it was not recorded.
        chose: per task, (R, E): the tick of the first choice; -1 where there was none.
        chances: per task, of the E scenes: the recorded chance of a right first choice without memory; None if none is.
        num_carriers, is_untrained: PONDER's K, and whether either model is random; None and False if unknown.
    """

    label: str
    config: Mapping[str, Any]
    outcomes: Mapping[str, NDArray[np.int64]]
    scenes: Mapping[str, tuple[Scene, ...]]
    ceilings: Mapping[str, tuple[Fraction | None, ...]]
    first_done: Mapping[str, NDArray[np.int64]]
    first_choices: Mapping[str, NDArray[np.int64]]
    chose: Mapping[str, NDArray[np.int64]]
    chances: Mapping[str, tuple[Fraction | None, ...]]
    num_carriers: int | None = None
    is_untrained: bool = False

    @property
    def tasks(self) -> tuple[str, ...]:
        return tuple(self.outcomes)

    @property
    def num_runs(self) -> int:
        return len(next(iter(self.outcomes.values())))

    def of(self, tasks: Sequence[str]) -> list[NDArray[np.int64]]:
        """Returns the outcomes of some of the tasks, in their order."""
        return [self.outcomes[task] for task in tasks]


def read_results(path: Path) -> Results:
    """Reads a results file, or that of a folder.

    Raises:
        OSError, FileError: the file cannot be read, or is no results file.
        ResultsError: no episodes, a task that is not in the paper, a scene twice in one run, or runs
            over different scenes, as in an unfinished evaluation.
    """
    file = path / RESULTS if path.is_dir() else path
    kind = "results file of pp-eval or sim-client"
    found = files.read_json(file, kind)
    with files.reading(file, kind):
        episodes, config = list(found["episodes"]), dict(found["config"])
        cells = Counter((e["task"], e.get("run", 0), (e["seed"], e["difficulty"])) for e in episodes)
        by_cell = {(e["task"], e.get("run", 0), (e["seed"], e["difficulty"])): e for e in episodes}
        successes = {cell: bool(e["success"]) for cell, e in by_cell.items()}
        done = {cell: _tick(e, "first_done_tick") for cell, e in by_cell.items()}
        chose = {cell: _tick(e, "first_choice_tick") for cell, e in by_cell.items()}
        choices = {cell: _CHOICES[e.get("first_choice")] for cell, e in by_cell.items()}
        of_chance = {(e["task"], (e["seed"], e["difficulty"])): e.get("first_choice_chance") for e in episodes}
        chances = {scene: Fraction(*map(int, ratio)) if ratio else None for scene, ratio in of_chance.items()}
        recorded = {(e["task"], e["seed"], e["difficulty"]): e.get("ceiling_without_memory") for e in episodes}
        ceilings = {
            (task, (seed, difficulty)): Fraction(*map(int, ratio)) if ratio else ceiling_of(task, difficulty)
            for (task, seed, difficulty), ratio in recorded.items()
        }
        models = [(proc, dict(model)) for episode in episodes for proc, model in episode.get("models", {}).items()]
        num_carriers = next((int(model["num_carriers"]) for proc, model in models if proc == "ponder"), None)
        is_untrained = any(model["is_untrained"] for _, model in models)
    _require(bool(episodes), f"{file}: no episode is finished yet; let pp-eval go on")
    for (task, run, (seed, _)), count in cells.items():
        _require(task in paper.TASKS, f"{file}: {task!r} is none of the sixteen tasks of the paper's Table 7")
        _require(count == 1, f"{file}: {task} seed {seed} is there {count} times in run {run}; count each scene once")
    runs = sorted({run for _, run, _ in cells})
    scenes = {
        task: tuple(sorted({scene for name, _, scene in cells if name == task}))
        for task in paper.TASKS
        if any(name == task for name, _, _ in cells)
    }
    missing = [(task, run, seed) for task in scenes for run in runs for seed, d in scenes[task]
               if (task, run, (seed, d)) not in cells]  # fmt: skip
    if missing:
        task, run, seed = missing[0]
        raise ResultsError(
            f"{file}: {len(missing)} episodes are missing, the first is {task} seed {seed} of run {run}; start the "
            "same pp-eval again, it goes on where it was"
        )

    def of_cells(values: Mapping[tuple[str, int, Scene], int]) -> dict[str, NDArray[np.int64]]:
        return {
            task: np.array([[int(values[task, run, scene]) for scene in of_task] for run in runs])
            for task, of_task in scenes.items()
        }

    return Results(
        label=str(path.parent if path.name == RESULTS else path),
        config=config,
        outcomes=of_cells(successes),
        scenes=scenes,
        ceilings={task: tuple(ceilings[task, scene] for scene in of_task) for task, of_task in scenes.items()},
        first_done=of_cells(done),
        first_choices=of_cells(choices),
        chose=of_cells(chose),
        chances={task: tuple(chances[task, scene] for scene in of_task) for task, of_task in scenes.items()},
        num_carriers=num_carriers,
        is_untrained=is_untrained,
    )


def _tick(episode: Mapping[str, Any], name: str) -> int:
    return -1 if (at := episode.get(name)) is None else int(at)


def read_comparable(paths: Sequence[Path]) -> list[Results]:
    """Reads several conditions over the same tasks. Raises ResultsError as `read_results` and `comparable` do."""
    return comparable([read_results(path) for path in paths])


def comparable(results: list[Results]) -> list[Results]:
    """Returns the conditions. Raises ResultsError if one has other tasks than the first, or for a repeated label."""
    _require(bool(results), "no results were given")
    first = results[0]
    for i, other in enumerate(results[1:], 1):
        _require(
            other.tasks == first.tasks,
            f"{other.label} has the tasks {', '.join(other.tasks)}, and {first.label} has {', '.join(first.tasks)}: "
            "means over other tasks cannot stand side by side; make tables of each by itself",
        )
        _require(other.label not in [each.label for each in results[:i]], f"{other.label} was given twice")
    return results


def _require(holds: bool, sentence: str) -> None:
    if not holds:
        raise ResultsError(sentence)
