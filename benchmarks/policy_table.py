"""The table of the laptop pair and its baselines, and what was named before it was played: controls and contrasts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from benchmarks.policy_plan import ROWS, WITH_PONDER
from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.results import RESULTS, Results, read_results
from dual_system.analysis.statistics import bootstrap, paired, sign_test, success_rate, wilson
from dual_system.training import laptop_recipes as recipes

OURS, CURRENT, FRAMES, OBSERVATION = (
    recipe.__name__
    for recipe in (recipes.laptop, recipes.laptop_current, recipes.laptop_framesamp, recipes.laptop_observation)
)
ORACLE = "laptop_text_grounded"
LABELS = {
    OURS: "words of A2 and C",
    CURRENT: "words of A2 and C",
    FRAMES: "none",
    "laptop_framesamp_grounded": "words of C",
    OBSERVATION: "none",
    "laptop_window": "none",
    "laptop_without_grounding": "none",
    ORACLE: "the simulator's words",
    "laptop_text_simple": "the simulator's words",
    "laptop_text_predicted": "words of A2",
}
"""What a row is told of the tasks beyond actions. The hand that all of them share has read places and words in B."""
CONTRASTS = (FRAMES, CURRENT)
_DELAYED = {recipe.__name__ for recipe in (*WITH_PONDER, recipes.laptop_text)}
_LEVEL, _MIN_TASKS = 0.01, 3
_LEAST_SHARE = 0.6
"""A control's upper bound is at least this share of (ceiling x success of the oracle's words)."""


def table(folder: Path) -> str:
    """Returns the rows that have been played in ``folder / "test"``, controls and contrasts; "" before the first."""
    played = {path.parent.name: read_results(path) for path in sorted((folder / "test").glob(f"*/{RESULTS}"))}
    if not played:
        return ""
    rows = [_row(name, results, folder) for name, results in played.items()]
    head = ["row", "scenes", "success, %", "first choice right, %", "without memory at most, %", "labels"]
    head += ["parameters", "core-hours", "delay, ms", "CPU-ms and bytes a robot second"]
    parts = ["## The table", markdown(head, rows)]
    if controls := list(_controls(played)):
        parts += ["## Controls", markdown(["row", "success, %", "band, %", "is a control"], controls)]
    if contrasts := _contrasts(played):
        head = ["PonderPounce minus", "seed", "success", "scenes better, worse", "tasks better"]
        parts += ["## The two contrasts", markdown([*head, "sign test p, Holm", "is met"], contrasts)]
    return "\n\n".join(parts) + "\n"


def _row(name: str, results: Results, folder: Path) -> list[str]:
    choices = np.concatenate([each.ravel() for each in results.first_choices.values()])
    made = choices[choices >= 0]
    scenes = sorted({len(each) for each in results.scenes.values()})
    ceiling = _ceiling(results)
    recipe, seed = _trained_as(name)
    return [
        name,
        f"{len(results.tasks)} x {'-'.join(map(str, scenes))}",
        percent(bootstrap(results.of(results.tasks))),
        percent(wilson(float(made.mean()), made.size)) if made.size else "",
        "" if ceiling is None else f"{100 * ceiling:.1f}",
        LABELS.get(name, LABELS.get(recipe, "")),
        _parameters(folder / "rows" / f"{recipe}_{seed}"),
        _core_hours(folder, recipe, seed),
        str(results.config.get("delay_ms", "")) if recipe in _DELAYED else "0",
        _cost(folder / "cost" / f"{recipe}.json"),
    ]


def _cost(file: Path) -> str:
    """Medians of both models' calls, one of each a second, and the bytes of a cognition (`policy_cost`)."""
    if not file.is_file():
        return ""
    found = json.loads(file.read_text())
    spent_ms = sum(found[name]["p50"] for name in ("ponder_cpu_ms", "pounce_cpu_ms") if name in found)
    return f"{spent_ms:.0f}, {found['cognition_bytes']}"


def _trained_as(name: str) -> tuple[str, int]:
    """Recipe and seed of a folder of plays, whose name begins with them; a text row has one seed and says how."""
    names = sorted({recipe.__name__ for recipe, _ in ROWS}, key=len, reverse=True)
    recipe = next((each for each in names if name == each or name.startswith(f"{each}_")), name)
    seed = name.removeprefix(f"{recipe}_").partition("_")[0]
    return recipe, int(seed) if seed.isdigit() else 0


def _ceiling(results: Results) -> float | None:
    """Mean over tasks of the best success without memory in the scenes that were played; None if one is not known."""
    shares = [[each for each in results.ceilings[task] if each is not None] for task in results.tasks]
    if any(len(known) < len(results.scenes[task]) for known, task in zip(shares, results.tasks, strict=True)):
        return None
    return float(np.mean([float(sum(known)) / len(known) for known in shares]))


def _controls(played: Mapping[str, Results]) -> Iterator[list[str]]:
    """The null and the current observation: neither broken nor above what luck allows."""
    if ORACLE not in played:
        return
    told = success_rate(played[ORACLE].of(played[ORACLE].tasks))
    for name, results in played.items():
        ceiling = _ceiling(results)
        if ceiling is not None and (name.endswith("_null") or name.startswith(OBSERVATION)) and "retold" not in name:
            found = bootstrap(results.of(results.tasks))
            least = _LEAST_SHARE * ceiling * told
            is_one = found.high >= least and found.low <= ceiling
            yield [name, percent(found), f"{100 * least:.1f} to {100 * ceiling:.1f}", "yes" if is_one else "**no**"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Contrast:
    """PonderPounce against one row, over all pairs of a seed of each."""

    other: str
    rows: tuple[list[str], ...]
    p_value: float
    is_one_sided: bool
    """Whether every seed has the same sign, and enough tasks that of all together."""


def _contrasts(played: Mapping[str, Results]) -> list[list[str]]:
    found = [each for other in CONTRASTS if (each := _contrast(other, played)) is not None]
    return [
        row
        for each, p_value in zip(found, _holm([each.p_value for each in found], len(CONTRASTS)), strict=True)
        for row in (*each.rows, _verdict(each, p_value))
    ]


def _contrast(other: str, played: Mapping[str, Results]) -> _Contrast | None:
    """None unless both were played. A row with one seed is compared with both seeds of PonderPounce."""
    ours = {seed: played[name] for seed in (0, 1) if (name := f"{OURS}_{seed}") in played}
    theirs = {seed: played[name] for seed in (0, 1) if (name := f"{other}_{seed}") in played}
    if not ours or not theirs:
        return None
    pairs = [(seed, results, theirs.get(seed, next(iter(theirs.values())))) for seed, results in ours.items()]
    rows, signs, gains = [], set(), []
    for seed, after, before in pairs:
        tasks = [task for task in after.tasks if after.scenes[task] == before.scenes.get(task)]
        gain = paired(before.of(tasks), after.of(tasks))
        by_task = [success_rate(after.of([task])) - success_rate(before.of([task])) for task in tasks]
        gains.append([_gains(before, after, task) for task in tasks])
        signs.add(math.copysign(1, gain.difference.value) if gain.difference.value else 0.0)
        better = sum(each > 0 for each in by_task)
        change = f"{gain.num_better}, {gain.num_worse}"
        rows.append([other, str(seed), percent(gain.difference, "+"), change, f"{better} of {len(tasks)}", "", ""])
    of_scenes = [sum(of_seed) for of_seed in zip(*gains, strict=True)]
    together = np.concatenate(of_scenes)
    means = [float(each.mean()) for each in of_scenes]
    same = max(sum(each > 0 for each in means), sum(each < 0 for each in means))
    return _Contrast(
        other=other,
        rows=tuple(rows),
        p_value=sign_test(int((together > 0).sum()), int((together < 0).sum())),
        is_one_sided=len(signs) == 1 and 0.0 not in signs and same >= _MIN_TASKS,
    )


def _gains(before: Results, after: Results, task: str) -> NDArray[np.int64]:
    """(E,): of each scene, successes more or fewer than in the other row, of one run each."""
    gains: NDArray[np.int64] = after.outcomes[task].sum(0) - before.outcomes[task].sum(0)
    return gains


def _verdict(contrast: _Contrast, p_value: float) -> list[str]:
    is_met = p_value < _LEVEL and contrast.is_one_sided
    return [f"**{contrast.other}**", "all", "", "", "", f"{p_value:.2g}", "met" if is_met else "**not met**"]


def _holm(p_values: Sequence[float], count: int) -> list[float]:
    """Holm's correction of the given p-values among ``count`` that were named; those that are missing count as 1."""
    order, found, least = np.argsort(p_values), [1.0] * len(p_values), 0.0
    for place, index in enumerate(order):
        least = max(least, min(1.0, (count - place) * p_values[index]))
        found[index] = least
    return found


def _parameters(folder: Path) -> str:
    """Weights of a row's checkpoints in millions; "" before it is trained."""
    count = 0
    for file in folder.glob("po*/model.safetensors"):
        with safe_open(file, "np") as weights:
            names: list[str] = weights.keys()
            count += sum(math.prod(weights.get_slice(name).get_shape()) for name in names)
    return f"{count / 1e6:.2f} M" if count else ""


def _core_hours(folder: Path, recipe: str, seed: int) -> str:
    """What joint training of the row has cost, of the account; what rows share is not counted."""
    places = [(each.__name__, of_seed) for each, of_seed in ROWS]
    file = folder / "hours.jsonl"
    if (recipe, seed) not in places or not file.is_file():
        return ""
    place = places.index((recipe, seed))
    entries = [json.loads(line) for line in file.read_text().splitlines()]
    spent_s = sum(
        entry.get("core_s_by_command", {}).get(f"{place % 2}", 0.0)
        for entry in entries
        if entry["stage"] == f"rows {place // 2 + 1}"
    )
    return f"{spent_s / 3600:.2f}" if spent_s else ""
