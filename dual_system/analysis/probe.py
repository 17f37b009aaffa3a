"""Linear probes: what can be read off a vector by ridge regression that task and time alone do not tell.

Episodes are divided into folds, so no instant is predicted from others of its episode, and the penalty is chosen on a
fold that is neither fitted nor scored. Tasks are probed one by one. A linear probe finds what a linear reader could
use; it shows neither that POUNCE uses it nor that what it misses is not there.
"""

# N instants, D features, C targets

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dual_system.analysis.markdown import markdown, percent
from dual_system.analysis.statistics import bootstrap_mean

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

ABOUT = """\
Ridge regression at one instant a second, episodes held out. Place: of the current subgoal, in pixels of a 256 px
picture, mean distance and R2; stage: the subgoal's number; count: how many before it began with the same word; shares
predicted rightly. Every row also knows the task and the time. 95 % intervals by a bootstrap of episodes."""
TIME = "task and time alone"
_FOLDS = 5
_PENALTIES = np.logspace(-3, 4, 8)
"""They are for standardised features, as a share of the number of instants."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Instants:
    """Instants of one task's episodes: what was to be done, and what each model held."""

    episode_N: Ints
    second_N: Ints
    """Since the episode's first tick."""
    place_N2: Array
    """Place that the current subgoal names [px]; NaN where it names none."""
    stage_N: Ints
    count_N: Ints
    held: Mapping[str, Array]
    """(N, D) by the name of the model."""


def probe_table(tasks: Mapping[str, Instants]) -> str:
    """Returns a row for each task and model. Raises ValueError if a task has fewer episodes than there are folds."""
    rows = []
    for task, instants in tasks.items():
        if (found := len(np.unique(instants.episode_N))) < _FOLDS:
            raise ValueError(f"{task}: expected at least {_FOLDS} episodes, one for each fold, came {found}")
        known = _of_time(instants.second_N)
        for name, held_ND in ({TIME: np.zeros((len(known), 0))} | dict(instants.held)).items():
            rows.append([task, name, *_scores(np.concatenate([known, held_ND], axis=1), instants)])
    return markdown(["task", "probe of", "place, px", "place, R2", "stage, %", "count, %"], rows) + "\n"


def _scores(features_ND: Array, instants: Instants) -> list[str]:
    episode_N = instants.episode_N
    cells = ["", ""]
    is_placed_N = ~np.isnan(instants.place_N2).any(axis=1)
    if len(np.unique(episode_N[is_placed_N])) >= _FOLDS:
        wanted_N2, of_N = instants.place_N2[is_placed_N], episode_N[is_placed_N]
        wrong_N2 = predicted(features_ND[is_placed_N], wanted_N2, of_N) - wanted_N2
        distance = bootstrap_mean(_by_episode(np.linalg.norm(wrong_N2, axis=1), of_N))
        cells = [
            f"{distance.value:.1f} [{distance.low:.1f}, {distance.high:.1f}]",
            f"{1 - np.square(wrong_N2).sum() / np.square(wanted_N2 - wanted_N2.mean(axis=0)).sum():.2f}",
        ]
    for label_N in (instants.stage_N, instants.count_N):
        kinds, kind_N = np.unique(label_N, return_inverse=True)
        guess_N = predicted(features_ND, np.eye(len(kinds))[kind_N], episode_N).argmax(axis=1)
        cells.append(percent(bootstrap_mean(_by_episode((guess_N == kind_N).astype(float), episode_N))))
    return cells


def predicted(features_ND: Array, wanted_NC: Array, episode_N: Ints) -> Array:
    """Ridge predictions (N, C) of every instant, by weights fitted to other episodes."""
    order = np.unique(episode_N, return_inverse=True)[1]
    fold_N = order % _FOLDS
    found_NC = np.empty_like(wanted_NC)
    for fold in range(_FOLDS):
        is_scored_N, is_chosen_on_N = fold_N == fold, fold_N == (fold + 1) % _FOLDS
        is_fitted_N = ~is_scored_N & ~is_chosen_on_N
        tried_PNC = _fitted(features_ND[is_fitted_N], wanted_NC[is_fitted_N], features_ND[is_chosen_on_N])
        best = int(np.square(tried_PNC - wanted_NC[is_chosen_on_N]).mean(axis=(1, 2)).argmin())
        others_ND, others_NC = features_ND[~is_scored_N], wanted_NC[~is_scored_N]
        found_NC[is_scored_N] = _fitted(others_ND, others_NC, features_ND[is_scored_N])[best]
    return found_NC


def _fitted(features_ND: Array, wanted_NC: Array, asked_MD: Array) -> Array:
    """Predictions (P, M, C) at every penalty. A feature that never changes counts for nothing."""
    centre_D, scale_D = features_ND.mean(axis=0), features_ND.std(axis=0)
    scale_D = np.where(scale_D > 1e-9 * (1 + np.abs(centre_D)), scale_D, np.inf)
    x_ND, mean_C = (features_ND - centre_D) / scale_D, wanted_NC.mean(axis=0)
    value_D, basis_DD = np.linalg.eigh(x_ND.T @ x_ND / len(x_ND))
    seen_DC = basis_DD.T @ x_ND.T @ (wanted_NC - mean_C) / len(x_ND)
    asked_MD = (asked_MD - centre_D) / scale_D @ basis_DD
    return np.stack([asked_MD @ (seen_DC / (value_D + penalty)[:, None]) for penalty in _PENALTIES]) + mean_C


def _of_time(second_N: Ints) -> Array:
    """Features of the time: which second it is, and how long since the beginning."""
    share_N = second_N / max(1, second_N.max())
    return np.concatenate([np.eye(second_N.max() + 1)[second_N], share_N[:, None], share_N[:, None] ** 2], axis=1)


def _by_episode(values_N: Array, episode_N: Ints) -> Array:
    return np.array([values_N[episode_N == each].mean() for each in np.unique(episode_N)])
