"""P(own): whether a policy acts on its own past, over counterfactual pairs whose presents are equal to the last bit.

The policy predicts twice per pair, once with each past, and each prediction is compared with the script's next actions
in both branches. P(own) is how often it is closer to the branch whose past was given. A policy that ignores the past
predicts the same twice, so it is right once and wrong once, or tied: it scores exactly 1/2.

Heed: how far the end of the policy's chunk moves when the other branch's past is given, over how far the script's does,
along the same direction. 0 is a policy that ignores it, 1 one that goes all the way; a low loss shows neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol import files

COUNTERFACTUAL = "counterfactual.json"
SCHEMA = "ponderpounce-counterfactual/1"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counterfactual:
    """Result of ``pp-diagnose counterfactual`` for one pair of checkpoints: per task, (P,) mean scores of its pairs."""

    label: str
    by_task: Mapping[str, NDArray[np.float64]]
    heed_by_task: Mapping[str, NDArray[np.float64]]
    """(P,), NaN where the scripts end alike, or for all pairs of a file of an earlier release."""
    is_untrained: bool

    @property
    def scores_P(self) -> NDArray[np.float64]:
        return np.concatenate(list(self.by_task.values()))


def read_counterfactual(path: Path) -> Counterfactual:
    """Reads a result file, or that of a folder. Raises OSError or FileError if it is not one or has no pairs."""
    file = path / COUNTERFACTUAL if path.is_dir() else path
    kind = "file of pp-diagnose counterfactual"
    found = files.read_json(file, kind)
    with files.reading(file, kind):
        if found["schema"] != SCHEMA or not found["pairs"]:
            raise ValueError(
                f"schema {found['schema']!r} with {len(found['pairs'])} pairs, expected some of {SCHEMA!r}"
            )
        scores: dict[str, list[float]] = {}
        heeds: dict[str, list[float]] = {}
        for pair in found["pairs"]:
            scores.setdefault(pair["task"], []).append(float(pair["score"]))
            heed = pair.get("heed")
            heeds.setdefault(pair["task"], []).append(float("nan") if heed is None else float(heed))
        is_untrained = any(model["is_untrained"] for model in found["models"].values())
    label = str(path.parent if path.name == COUNTERFACTUAL else path)
    by_task = {task: np.array(of_task) for task, of_task in sorted(scores.items())}
    heed_by_task = {task: np.array(of_task) for task, of_task in sorted(heeds.items())}
    return Counterfactual(label=label, by_task=by_task, heed_by_task=heed_by_task, is_untrained=is_untrained)


def follows_own_past(predicted: ArrayLike, script: ArrayLike, *, scale: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns for each pair and branch (P, 2): 1 if the prediction follows the given past, 0 the other, 1/2 if tied.

    Args:
        predicted: (P, 2, H, A) actions of the policy; [p, b] is given the past of branch b.
        script: (P, 2, H, A) the script's next actions in the branches.
        scale: (A,) divisors of the differences per action dim, such as the standard deviations in the training data;
            1 by default, so that a radian weighs as much as a gripper command of 1.

    Raises:
        ValueError: shapes differ or are not (P, 2, H, A), values are not finite, or a scale is not positive.
    """
    answers, scripts = _scaled(predicted, script, scale)
    own = np.sum((answers - scripts) ** 2, axis=(2, 3))
    other = np.sum((answers - scripts[:, ::-1]) ** 2, axis=(2, 3))
    return np.where(own < other, 1.0, np.where(own > other, 0.0, 0.5))


def heed(predicted: ArrayLike, script: ArrayLike, *, scale: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns how far each pair's last rows are apart, (P,), in units of the script's; NaN where the script's are not.

    The arguments and errors are those of `follows_own_past`.
    """
    answers, scripts = _scaled(predicted, script, scale)
    moved, wanted = (each[:, 1, -1] - each[:, 0, -1] for each in (answers, scripts))
    length = np.sum(wanted**2, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share: NDArray[np.float64] = np.sum(moved * wanted, axis=1) / length
    return np.where(length > 0, share, np.nan)


def _scaled(
    predicted: ArrayLike, script: ArrayLike, scale: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    answers, scripts = np.asarray(predicted, dtype=np.float64), np.asarray(script, dtype=np.float64)
    if answers.shape != scripts.shape or answers.ndim != 4 or answers.shape[1] != 2:
        raise ValueError(f"expected (P, 2, H, A) twice; got predicted {answers.shape} and script {scripts.shape}")
    divisors = np.ones(answers.shape[3]) if scale is None else np.asarray(scale, dtype=np.float64)
    if divisors.shape != answers.shape[3:] or not np.all(divisors > 0):
        raise ValueError(f"expected {answers.shape[3]} positive scales; got {divisors.tolist()}")
    if not (np.isfinite(answers).all() and np.isfinite(scripts).all()):
        raise ValueError("predicted and script must be finite")
    return answers / divisors, scripts / divisors


def p_own(predicted: ArrayLike, script: ArrayLike, *, scale: ArrayLike | None = None) -> float:
    """Returns P(own), the mean of `follows_own_past` over all pairs and branches.

    Raises ValueError as that does, and if there are no pairs.
    """
    scores = follows_own_past(predicted, script, scale=scale)
    if not scores.size:
        raise ValueError("no pairs, no score")
    return float(scores.mean())
