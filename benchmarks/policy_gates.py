"""The gates before joint training: what the hand that all rows share must do, measured on development scenes.

A gate that stays shut narrows what the rows can show; it stops nothing (docs/training.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.policy_plan import GATES, HEED
from dual_system.analysis.counterfactual import COUNTERFACTUAL, read_counterfactual
from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.results import RESULTS, Results, read_results
from dual_system.analysis.statistics import Interval, bootstrap_mean, success_rate, wilson

Row = list[str]


def gates(folder: Path) -> str:
    """Returns a row for each gate whose plays are finished in ``folder``; "" before the first is."""
    found = {name: read_results(folder / name) for name in GATES if (folder / name / RESULTS).is_file()}
    rows = [row for gate in (_told, _blind, _looks, _heeds, _sees) for row in gate(found, folder)]
    return markdown(["gate", "wanted", "found, % [95 %]", "is open"], rows) + "\n" if rows else ""


def _told(found: dict[str, Results], folder: Path) -> list[Row]:
    """(i) Told what to do, it does it."""
    wanted = {"grounded": 0.75, "simple": 0.65}
    return [
        _row(
            f"(i) told {name}", f"≥ {100 * least:.0f}", _interval(found[name]), lambda rate, least=least: rate >= least
        )
        for name, least in wanted.items()
        if name in found
    ]


def _blind(found: dict[str, Results], folder: Path) -> list[Row]:
    """(ii) Shown another scene, it fails: it acts on what it sees."""
    told = _told_rate(found)
    if not told or "other_scene" not in found:
        return []
    most = told / 2
    shown = _interval(found["other_scene"])
    return [_row("(ii) another scene's pictures", f"≤ {100 * most:.0f}", shown, lambda rate: rate <= most)]


def _looks(found: dict[str, Results], folder: Path) -> list[Row]:
    """(iii) Told places 12 px off, it looks for what is meant."""
    told = _told_rate(found)
    if not told or "displaced" not in found:
        return []
    least = 0.7 * told
    shown = _interval(found["displaced"])
    return [_row("(iii) told places 12 px off", f"≥ {100 * least:.0f}", shown, lambda rate: rate >= least)]


def _heeds(found: dict[str, Results], folder: Path) -> list[Row]:
    """(iv) Told another thing in the same picture, its chunk ends at least half of the way to it."""
    rows = []
    for path in sorted(folder.glob(f"{HEED}*/{COUNTERFACTUAL}")):
        for task, heeds in read_counterfactual(path).heed_by_task.items():
            shown = bootstrap_mean(heeds[~np.isnan(heeds)])
            rows.append(_row(f"(iv) heed, {task}", "≥ 50", shown, lambda rate: rate >= 0.5))
    return rows


def _sees(found: dict[str, Results], folder: Path) -> list[Row]:
    """(v) Told the task alone, it solves the scenes that ask for no memory."""
    if "alone" not in found:
        return []
    alone = found["alone"]
    easy = [
        outcomes[:, np.array([ceiling == 1 for ceiling in alone.ceilings[task]])].ravel()
        for task, outcomes in alone.outcomes.items()
    ]
    solved = np.concatenate(easy)
    if not solved.size:
        return []
    shown = wilson(float(solved.mean()), solved.size)
    return [
        _row(f"(v) the task alone, {solved.size} scenes that need no memory", "≥ 60", shown, lambda rate: rate >= 0.6)
    ]


def _told_rate(found: dict[str, Results]) -> float:
    """Success of the hand that is told places, by which others are measured; 0 before it was played."""
    return success_rate(list(found["grounded"].outcomes.values())) if "grounded" in found else 0.0


def _interval(results: Results) -> Interval:
    outcomes = np.concatenate([each.ravel() for each in results.outcomes.values()])
    return wilson(float(outcomes.mean()), outcomes.size)


def _row(gate: str, wanted: str, found: Interval, opens: Callable[[float], bool]) -> Row:
    return [gate, wanted, percent(found), "yes" if opens(found.value) else "**no**"]
