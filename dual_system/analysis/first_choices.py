"""What `pp-tables` says of first choices: of the episodes that committed to something, how many chose rightly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis.ceiling import LAST_DISC_STEP
from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.results import Results
from dual_system.analysis.statistics import wilson

ABOUT_FIRST_CHOICES = """\
Of the episodes that committed to a container, cube, manner, count or direction, how many chose rightly, with Wilson's
interval over their scenes, and how many the best player without memory would choose rightly in the same scenes."""

ABOUT_RETOLD = """\
Scenes that were played twice, after their own past and after another that leads to the same present (`--pictures
retold`). Of those with a first choice in both plays, in how many it was right in both, in one, in neither. A policy
that ignores the past chooses alike twice and is right in one at most."""

_OF_PLAY = ("out", "pictures", "tasks", "record", "record_hz", "pixels", "progress", "patience_s", "link")
"""Options that may differ between two plays of one condition."""

_Part = tuple[str, NDArray[np.bool_], bool | None]  # a name, its episodes (R, E), and whether the discs were in sight


def first_choices(results: Sequence[Results]) -> str:
    """Returns a row for each task and condition; "" if no first choice was recorded."""
    rows = []
    for task in results[0].tasks:
        for each in results:
            is_made = each.first_choices[task] >= 0
            made = [(name, is_made & part, saw) for name, part, saw in _parts(each, task)]
            found = [
                [task + name, each.label, *_row(each, task, chosen, saw)] for name, chosen, saw in made if chosen.any()
            ]
            if not found and any(each.chances[task]):
                found.append([task, each.label, f"0 of {is_made.size}", "0", "", ""])
            rows += found
    return markdown(["task", "condition", "committed", "right", "right, %", "chance, %"], rows) if rows else ""


def _parts(results: Results, task: str) -> Iterator[_Part]:
    """PickHighlight's episodes by what the player could see: it may choose before the button, or beside the discs."""
    pressed, chose = results.first_done[task], results.chose[task]
    if task != "PickHighlight":
        yield "", np.full(chose.shape, True), False
        return
    is_after = (pressed >= 0) & (pressed <= chose)
    yield ", button pressed first", is_after & (pressed > LAST_DISC_STEP), False
    yield f", button pressed by step {LAST_DISC_STEP}, discs in sight", is_after & (pressed <= LAST_DISC_STEP), True
    yield ", chosen before the button", ~is_after, None


def _row(results: Results, task: str, chosen_RE: NDArray[np.bool_], saw_discs: bool | None) -> list[str]:
    num_chosen, num_right = int(chosen_RE.sum()), int(results.first_choices[task][chosen_RE].sum())
    right = percent(wilson(num_right / num_chosen, int(chosen_RE.any(axis=0).sum())))
    scenes = np.nonzero(chosen_RE)[1]
    known = [each for scene in scenes if (each := results.chances[task][scene]) is not None]
    if saw_discs:
        known = [Fraction(1)] * num_chosen
    is_known = saw_discs is not None and len(known) == num_chosen
    chance = f"{100 * float(sum(known, Fraction(0)) / num_chosen):.2f}" if is_known else ""
    return [f"{num_chosen} of {chosen_RE.size}", str(num_right), right, chance]


def is_retold(results: Results) -> bool:
    """Whether scenes were played after another past than their own."""
    return results.config.get("pictures") == "retold"


def retold(own: Sequence[Results], others: Sequence[Results]) -> str:
    """Returns a row for each condition and task that was played after both pasts; "" if none was."""
    rows = [
        row
        for ours in own
        for theirs in others
        if _settings(ours) == _settings(theirs)
        for task in ours.tasks
        if ours.scenes[task] == theirs.scenes.get(task)
        for row in _both(task, ours, theirs)
    ]
    return markdown(["task", "condition", "chose twice", "both right", "one", "none", "both, %"], rows) if rows else ""


def _both(task: str, ours: Results, theirs: Results) -> Iterator[list[str]]:
    """The row of a task, if any scene was chosen in twice."""
    is_made = (ours.first_choices[task] >= 0) & (theirs.first_choices[task] >= 0)
    num_right = (ours.first_choices[task] + theirs.first_choices[task])[is_made]
    if num_right.size:
        counts = [int((num_right == count).sum()) for count in (2, 1, 0)]
        both = percent(wilson(counts[0] / num_right.size, int(is_made.any(axis=0).sum())))
        yield [task, ours.label, f"{num_right.size} of {is_made.size}", *map(str, counts), both]


def _settings(results: Results) -> dict[str, Any]:
    return {name: value for name, value in results.config.items() if name not in _OF_PLAY}
