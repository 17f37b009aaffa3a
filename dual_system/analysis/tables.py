"""``pp-tables``: tables and plots of results in the paper's form, with intervals, beside the paper's own numbers.

The output depends on the files alone, to the last digit: the bootstrap's seed is fixed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from dual_system.analysis import paper
from dual_system.analysis.ceiling_tables import ceilings
from dual_system.analysis.counterfactual import COUNTERFACTUAL, read_counterfactual
from dual_system.analysis.cue_age import ABOUT_CUE_AGE, by_cue_age
from dual_system.analysis.diagnosis import DIAGNOSIS, read_diagnosis
from dual_system.analysis.diagnosis_tables import counterfactual_table, diagnosis_tables
from dual_system.analysis.first_choices import ABOUT_FIRST_CHOICES, ABOUT_RETOLD, first_choices, is_retold, retold
from dual_system.analysis.goals import is_kitchen, kitchen_tables, read_kitchen
from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.results import Results, ResultsError, comparable, read_results
from dual_system.analysis.statistics import bootstrap, paired, wilson
from protocol import files
from protocol.command_line import command, parse

TABLES = "tables.md"
NOTE = f"""\
Success in per cent, 95 % intervals in brackets: of a task Wilson's over its scenes, of means a task-stratified
bootstrap over scenes and runs. Columns and rows marked "{paper.MARK}" are the paper's figures, over the same
tasks: other scenes, other pictures, other physics. They are no baseline of ours."""

ABOUT_DELAYS = """\
Means over the tasks, by the delay of what POUNCE gets, or of the newest picture of its memory; when it is used, it is
up to one query period older."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TablesOptions:
    """Makes the paper's tables and plots of whatever evaluations and diagnoses wrote."""

    results: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of pp-eval, sim-client, pp-diagnose or pp-diagnose counterfactual, or their files; conditions of an
    evaluation are compared with the first."""
    out: Path
    """Folder for tables.md, and for staleness.png of a diagnosis."""


@command("pp-tables")
def main(argv: list[str] | None = None) -> int:
    options = parse(TablesOptions, argv, prog="pp-tables")
    of_kind = {name: [p for p in options.results if _holds(p, name)] for name in (DIAGNOSIS, COUNTERFACTUAL)}
    evaluations = [p for p in options.results if not any(p in paths for paths in of_kind.values())]
    kitchens = [p for p in evaluations if is_kitchen(p)]
    evaluations = [p for p in evaluations if p not in kitchens]
    diagnoses, parts = [], []
    if kitchens:
        parts.append(kitchen_tables([read_kitchen(path) for path in kitchens]))
    if evaluations:
        played = [read_results(path) for path in evaluations]
        own = [each for each in played if not is_retold(each)]
        others = [each for each in played if is_retold(each)] if own else []
        parts.append(tables(comparable(own or played), others).rstrip("\n"))
    if of_kind[DIAGNOSIS]:
        diagnoses = [read_diagnosis(path) for path in of_kind[DIAGNOSIS]]
        parts.append(diagnosis_tables(diagnoses))
    if of_kind[COUNTERFACTUAL]:
        parts.append(counterfactual_table([read_counterfactual(path) for path in of_kind[COUNTERFACTUAL]]))
    with files.writing(files.folder(options.out)):
        if diagnoses:
            from dual_system.analysis.staleness_plot import plot_staleness  # needs Pillow; tables alone do not

            plot_staleness(diagnoses, options.out / "staleness.png")
        (options.out / TABLES).write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    sys.stdout.write(f"{options.out / TABLES}\n")
    return 0


def _holds(path: Path, name: str) -> bool:
    return path.name == name or (path / name).is_file()


def tables(results: Sequence[Results], after_another_past: Sequence[Results] = ()) -> str:
    """Returns all tables as markdown. Raises ResultsError if conditions were run on different scenes.

    Scenes that were retold are judged otherwise, so they are compared with their own past's alone (`retold`).
    """
    parts = ["# Evaluation", NOTE, "\n".join(_about(each) for each in results)]
    parts += ["## By family (form of the paper's Table 1)", by_family(results)]
    parts += ["## By task (form of the paper's Table 7)", by_task(results), *ceilings(results)]
    if first := first_choices(results):
        parts += ["## First choice", ABOUT_FIRST_CHOICES, first]
    if aged := by_cue_age(results):
        parts += ["## By the time since the cue was in sight", ABOUT_CUE_AGE, aged]
    if twins := retold(results, after_another_past):
        parts += ["## The same present after another past", ABOUT_RETOLD, twins]
    if curves := by_delay(results):
        parts += ["## By delay", ABOUT_DELAYS, curves]
    if len(results) > 1:
        parts += ["## Between conditions (form of the paper's Tables 3 and 4)", between_conditions(results)]
    return "\n\n".join(parts) + "\n"


def by_family(results: Sequence[Results]) -> str:
    """Returns a row for each family and the average, a column for each condition, then the paper's."""
    families = _families(results[0].tasks)
    rows = [[_of_family(name, tasks), *_means(results, tasks), *_papers(tasks)] for name, tasks in families.items()]
    every = results[0].tasks
    rows.append([f"**Average** of {_count(len(every), 'task')}", *_means(results, every), *_papers(every)])
    return markdown(["family", *_columns(results)], rows)


def by_task(results: Sequence[Results]) -> str:
    """Returns a row for each task, family by family."""
    rows = []
    for task in results[0].tasks:
        ours = [wilson(float(each.outcomes[task].mean()), len(each.scenes[task])) for each in results]
        rows.append([task, *map(percent, ours), *_papers((task,))])
    return markdown(["task", *_columns(results)], rows)


def between_conditions(results: Sequence[Results]) -> str:
    """Returns a row for each condition with its difference from the first, scene by scene, and the paper's rows.

    Raises ResultsError if one was run on other scenes than the first.
    """
    first, families = results[0], _families(results[0].tasks)
    head = ["condition", "POUNCE gets", "refresh", "delay", "K", *map(str.capitalize, families), "Average"]
    head += ["minus the first", "scenes better, worse", "sign test p"]
    rows = []
    for each in results:
        if each.scenes != first.scenes:
            raise ResultsError(
                f"{each.label} was not run on the scenes of {first.label}: differences are between the same scenes; "
                "give both evaluations the same --seed, --episodes and --difficulty"
            )
        means = [bootstrap(each.of(tasks)) for tasks in (*families.values(), each.tasks)]
        row = [each.label, *_condition(each), *map(percent, means)]
        if each is first:
            row += ["", "", ""]
        else:
            gain = paired(first.of(first.tasks), each.of(first.tasks))
            row += [percent(gain.difference, "+"), f"{gain.num_better}, {gain.num_worse}", f"{gain.p_value:.2g}"]
        rows.append(row)
    if set(first.tasks) == set(paper.TASKS):
        for number, table in ((3, paper.TABLE_3), (4, paper.TABLE_4)):
            for name, meanspercent in table.items():
                figures = [f"{mean:.2f}" for mean in meanspercent]
                rows.append([f"Table {number}: {name} ({paper.MARK})", "", "", "", "", *figures, "", "", ""])
    return markdown(head, rows)


def by_delay(results: Sequence[Results]) -> str:
    """Returns a row for each channel of a POUNCE that was played at several delays; "" if none was."""
    found: dict[str, dict[str, dict[int, Results]]] = {}
    for each in results:
        delay_ms, checkpoint = each.config.get("delay_ms"), each.config.get("pounce_checkpoint")
        if delay_ms is not None and checkpoint is not None:
            channels = found.setdefault(Path(checkpoint).parent.name, {})
            channels.setdefault(_condition(each)[0], {}).setdefault(delay_ms, each)
    found = {pounce: channels for pounce, channels in found.items() if max(map(len, channels.values())) > 1}
    delays = sorted({delay for channels in found.values() for curve in channels.values() for delay in curve})
    rows = []
    for pounce, channels in found.items():
        for gets, curve in channels.items():
            means = {delay: percent(bootstrap(played.of(played.tasks))) for delay, played in curve.items()}
            rows.append([f"{pounce}: {gets}", *(means.get(delay, "") for delay in delays)])
    return markdown(["POUNCE gets", *(f"{delay / 1000:g} s" for delay in delays)], rows) if rows else ""


_GIVEN = {
    "null": "the null cognition",
    "other-episode": "another episode's cognition",
}

_TOLD = {
    "ponder": "PONDER's subgoal text",
    "displaced": "the task's grounded subgoal, 12 px off",
    "grounded": "the task's grounded subgoal",
    "simple": "the task's subgoal without places",
    "oracle": "the task's grounded subgoal of the same tick",  # of earlier releases
}

_SHOWN = {
    "other-scene": "the pictures of another scene",
    "without-cue": "pictures without the cue",
    "retold": "another past",
}


def _condition(results: Results) -> tuple[str, str, str, str]:
    """POUNCE's cognition, PONDER's query period, its delay and K, as far as the file has them."""
    config = results.config
    if config.get("policy") == "oracle":
        return "nothing: the oracle played", "", "", ""
    gets = _GIVEN.get(_cognition(config), "C_t")
    told = config.get("subgoal_text", "ponder" if results.num_carriers == 0 else None)
    if told is not None:
        gets = _TOLD[told]
    if results.num_carriers == 0 and {"ponder_checkpoint": None}.items() <= config.items() and told == "ponder":
        gets = "nothing of PONDER's"
    reported_ms = config.get("held_age_ms", 0)
    if config.get("deliver") == "held-transition":
        gets += f" held at transitions, with {f'age {reported_ms} ms' if reported_ms else 'its true age'}"
    elif reported_ms:
        gets += f", told as {reported_ms} ms old"
    if (shown := config.get("pictures")) is not None:
        gets += f", {_SHOWN[shown]}"
    carriers = "" if results.num_carriers is None else str(results.num_carriers)
    return gets, _ms(config.get("query_period_ms")), _ms(config.get("delay_ms")), carriers


def _cognition(config: Any) -> str:
    return "null" if config.get("deliver") == "null" else config.get("cognition", "real")


def _about(results: Results) -> str:
    scenes = sum(len(of_task) for of_task in results.scenes.values())
    split = f"{results.config['split']} scene" if "split" in results.config else "scene"
    size = [_count(len(results.tasks), "task"), _count(scenes, split), _count(results.num_runs, "run")]
    mode, steps = results.config.get("mode", "unknown mode"), results.config.get("max_steps", "?")
    untrained = " **Untrained weights: motion, not skill.**" if results.is_untrained else ""
    return f"- `{results.label}`: {', '.join(size)}; {mode}, at most {steps} steps.{untrained}"


def _families(tasks: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The given tasks by family; families without any are left out."""
    found = {name: tuple(task for task in of if task in tasks) for name, of in paper.FAMILIES.items()}
    return {name: of for name, of in found.items() if of}


def _of_family(name: str, tasks: Sequence[str]) -> str:
    full = len(paper.FAMILIES[name])
    return name.capitalize() + ("" if len(tasks) == full else f" ({len(tasks)} of {full} tasks)")


def _means(results: Sequence[Results], tasks: Sequence[str]) -> list[str]:
    return [percent(bootstrap(each.of(tasks))) for each in results]


def _papers(tasks: Sequence[str]) -> list[str]:
    return [f"{paper.mean_of(method, tasks):.2f}" for method in paper.SHOWN]


def _columns(results: Sequence[Results]) -> list[str]:
    return [*(each.label for each in results), *(f"{method} ({paper.MARK})" for method in paper.SHOWN)]


def _ms(value: int | None) -> str:
    return "" if value is None else f"{value} ms"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
