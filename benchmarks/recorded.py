"""Recorded episodes of the public benchmark, and their scenes in our tasks, placed by the tests' own code.

A folder of recordings holds, per task, ``<Task>_train006.json`` and ``.npz``: goals, texts, actions, object poses and
frames of one episode of the benchmark's own planner. They are not part of this repository, but their scenes are, with
the values for the tests, in ``tests/tasks/data``.
"""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.task import task_names

_SUFFIX = "_train006"
_TESTS = Path(__file__).parents[1] / "tests" / "tasks"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """One recorded episode."""

    task: str
    facts: dict[str, Any]  # the JSON file
    arrays: dict[str, NDArray[Any]]  # the .npz file


def recorded_tasks(folder: Path) -> list[str]:
    """Returns our tasks with a recording in the folder. Raises FileNotFoundError if there is none."""
    found = [task for task in task_names() if (folder / f"{task}{_SUFFIX}.npz").exists()]
    if not found:
        raise FileNotFoundError(f"no <Task>{_SUFFIX}.npz of any of our tasks in {folder}; give --recordings the folder")
    return found


def read(task: str, folder: Path) -> Recording:
    """Returns the recording of a task."""
    with np.load(folder / f"{task}{_SUFFIX}.npz") as file:
        arrays = {name: file[name] for name in file.files}
    return Recording(task=task, facts=json.loads((folder / f"{task}{_SUFFIX}.json").read_text()), arrays=arrays)


def layout_of(task: str) -> Any | None:
    """Returns the recorded scene as the task's layout; None if no test has the task's recording."""
    for path in sorted(_TESTS.glob("test_*recordings.py")):
        module = importlib.import_module(f"tests.tasks.{path.stem}")
        if hasattr(module, "FILES") and task in module.FILES:
            of_recording = "recording" in module.layout_of.__annotations__
            return module.layout_of(module.recording_of(task) if of_recording else task)
        if hasattr(module, "LAYOUTS") and task in module.LAYOUTS:
            file, layout = module.LAYOUTS[task]
            return layout(json.loads((module.DATA / f"{file}{_SUFFIX}.json").read_text()))
    if task == "PickHighlight":  # the first of them; its tests are older than the pattern
        conftest = importlib.import_module("tests.tasks.conftest")
        return conftest.pick_highlight_layout(json.loads((_TESTS / "data/pick_highlight_train006.json").read_text()))
    return None
