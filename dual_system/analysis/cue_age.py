"""How often first choices are right, and episodes succeed, by how long ago the cue was last in sight."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from dual_system.analysis.ceiling import LAST_DISC_STEP
from dual_system.analysis.markdown import markdown
from dual_system.analysis.results import Results

LAST_SEEN = {"VideoUnmask": 0, "MoveCube": 0, "PatternLock": 0, "PickHighlight": LAST_DISC_STEP}
"""The last step at which the cue is in sight: a demonstration's is gone when the episode begins."""
_TICKS_PER_S = 20
_EDGES_S = (0, 4, 8, 16, 1 << 30)

ABOUT_CUE_AGE = """\
First choices by the seconds since the cue was last in sight: of a demonstration since the episode began, of
PickHighlight since its discs were gone. Right choices, solved episodes, and all that chose."""


def by_cue_age(results: Sequence[Results]) -> str:
    """Returns a row for each task and condition; "" if nobody chose after a cue had gone."""
    rows = []
    for task in results[0].tasks:
        for each in results:
            since = each.chose[task] - LAST_SEEN.get(task, 0)
            chose = (each.first_choices[task] >= 0) & (each.chose[task] >= 0) & (since >= 0)
            if task in LAST_SEEN and chose.any():
                cells = []
                for low_s, high_s in pairwise(_EDGES_S):
                    here = chose & (since >= low_s * _TICKS_PER_S) & (since < high_s * _TICKS_PER_S)
                    right, solved = int(each.first_choices[task][here].sum()), int(each.outcomes[task][here].sum())
                    cells.append(f"{right}, {solved} of {int(here.sum())}" if here.any() else "")
                rows.append([task, each.label, *cells])
    head = [f"{low} to {high} s" for low, high in pairwise(_EDGES_S[:-1])]
    return markdown(["task", "condition", *head, f"from {_EDGES_S[-2]} s"], rows) if rows else ""
