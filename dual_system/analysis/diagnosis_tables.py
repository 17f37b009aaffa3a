"""Tables of ``pp-diagnose`` and its counterfactual pairs, among them the paper's Figure 4 in numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis import paper
from dual_system.analysis.counterfactual import Counterfactual
from dual_system.analysis.diagnosis import CONDITIONS, FRESH_AGE_S, Diagnosis, absolute, ratio
from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.statistics import Interval, bootstrap_mean

DIAGNOSIS_NOTE = f"""\
Offline and teacher-forced: flow-matching loss on recorded episodes, the same ticks, targets and flow draws in every
condition; 95 % intervals in brackets by a bootstrap of episodes within tasks. No success rate. Rows marked
"{paper.MARK}" are reported in the paper's 5.2: another dataset and other models."""
COUNTERFACTUAL_NOTE = """\
Pairs of episodes with equal presents and different pasts: how often the action is closer to that of its own past. A
policy that ignores the past scores exactly 50. 95 % intervals by a bootstrap of pairs. Heed: how far the end of the
chunk moves with the other past, over how far the script's does; the median over pairs, and how many reach half."""


def diagnosis_tables(diagnoses: Sequence[Diagnosis]) -> str:
    """Returns all tables as markdown. Raises ValueError if a diagnosis has no ticks."""
    untrained = [f"- `{each.label}`: **untrained weights.**" for each in diagnoses if each.is_untrained]
    return "\n\n".join(
        [
            "# Diagnosis",
            DIAGNOSIS_NOTE,
            *(["\n".join(untrained)] if untrained else []),
            "## Staleness (the paper's Figure 4)",
            by_age(diagnoses),
            "![loss over cognition's age](staleness.png)",
            "## Whose cognition",
            by_condition(diagnoses),
        ]
    )


def by_age(diagnoses: Sequence[Diagnosis]) -> str:
    """Returns a row for each diagnosis: the loss at 0.3 s, and that at every age relative to it."""
    ages_s = [f"{FRESH_AGE_S + float(name):.1f}" for name in diagnoses[0].parts["staleness"].names]
    rows = []
    for each in diagnoses:
        losses = each.parts["staleness"]
        fresh = losses.names[0]
        row = [each.label, f"{losses.total_ticks} of {losses.num_episodes}", _loss(absolute(losses, fresh))]
        rows.append(row + [_times(ratio(losses, name, fresh)) for name in losses.names])
    for interval, loss in paper.FIGURE_4.items():
        known = [f"{loss[float(age_s)]:.2f}x" if float(age_s) in loss else "" for age_s in ages_s]
        label = f"trained at {interval} ({paper.MARK})"
        rows.append([label, "757 of 80", f"{paper.FIGURE_4_FRESH[interval]:.3f}", *known])
    return markdown(["checkpoint", "ticks of episodes", "loss at 0.3 s", *(f"{age} s" for age in ages_s)], rows)


def by_condition(diagnoses: Sequence[Diagnosis]) -> str:
    """Returns two rows for each diagnosis: over all ticks, and at branch points."""
    rows = []
    for each in diagnoses:
        for part, name in (("all", "all"), ("branch", "branch points")):
            losses = each.parts["all"] if part == "all" else each.parts["branch"]
            row = [each.label, name, f"{losses.total_ticks} of {losses.num_episodes}"]
            row += [_loss(absolute(losses, condition)) for condition in CONDITIONS]
            rows.append(row + [_times(ratio(losses, condition, "real")) for condition in CONDITIONS[1:]])
    head = ["checkpoint", "where", "ticks of episodes", *CONDITIONS]
    return markdown([*head, *(f"{condition} over real" for condition in CONDITIONS[1:])], rows)


def counterfactual_table(found: Sequence[Counterfactual]) -> str:
    """Returns a row for each file, task by task and over all pairs."""
    rows = []
    for each in found:
        heeds = [*each.heed_by_task.values(), np.concatenate(list(each.heed_by_task.values()))]
        for (task, scores_P), heed_P in zip([*each.by_task.items(), ("all", each.scores_P)], heeds, strict=True):
            row = [each.label, task, str(len(scores_P)), percent(bootstrap_mean(scores_P)), *_heed(heed_P)]
            rows.append([*row, "**untrained weights**" if each.is_untrained else ""])
    table = markdown(["checkpoint", "task", "pairs", "P(own past)", "heed", "heed of 0.5 or more", ""], rows)
    return "\n\n".join(["# Counterfactual history", COUNTERFACTUAL_NOTE, table])


def _heed(heed_P: NDArray[np.float64]) -> tuple[str, str]:
    known = heed_P[~np.isnan(heed_P)]
    if not len(known):
        return "", ""
    return f"{np.median(known):.2f}", f"{np.sum(known >= 0.5)} of {len(known)}"


def _loss(interval: Interval) -> str:
    return f"{interval.value:.3f} [{interval.low:.3f}, {interval.high:.3f}]"


def _times(interval: Interval) -> str:
    return f"{interval.value:.2f}x [{interval.low:.2f}, {interval.high:.2f}]"
