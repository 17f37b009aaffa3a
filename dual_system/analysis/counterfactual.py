"""Does a policy act on its own past? The score over counterfactual pairs, whose presents are the same to the last bit.

Of each pair the policy is asked twice, once with each past, and each answer is compared with what the script does next
in either branch. P(own) is how often the answer is closer to that of the branch whose past was given. A policy that
does not use the past gives the same answer twice, so it is right once and wrong once, or tied: it scores exactly 1/2.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.analysis.results import ResultsError

COUNTERFACTUAL = "counterfactual.json"
SCHEMA = "ponderpounce-counterfactual/1"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counterfactual:
    """What ``pp-counterfactual`` found for one pair of checkpoints: per task, (P,) mean scores of its pairs."""

    label: str
    by_task: Mapping[str, NDArray[np.float64]]
    is_untrained: bool

    @property
    def scores_P(self) -> NDArray[np.float64]:
        return np.concatenate(list(self.by_task.values()))


def read_counterfactual(path: Path) -> Counterfactual:
    """Reads a file of ``pp-counterfactual``, or that of a folder. Raises ResultsError if it is none or has no pairs."""
    file = path / COUNTERFACTUAL if path.is_dir() else path
    try:
        found = json.loads(file.read_text())
        if found["schema"] != SCHEMA or not found["pairs"]:
            raise ValueError(
                f"schema {found['schema']!r} with {len(found['pairs'])} pairs, expected some of {SCHEMA!r}"
            )
        scores: dict[str, list[float]] = {}
        for pair in found["pairs"]:
            scores.setdefault(pair["task"], []).append(float(pair["score"]))
        is_untrained = any(model["is_untrained"] for model in found["models"].values())
    except OSError as error:
        raise ResultsError(f"{file} cannot be read ({error.strerror}); give folders of pp-counterfactual") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultsError(f"{file} is no file of pp-counterfactual: {error!r}") from error
    label = str(path.parent if path.name == COUNTERFACTUAL else path)
    by_task = {task: np.array(of_task) for task, of_task in sorted(scores.items())}
    return Counterfactual(label=label, by_task=by_task, is_untrained=is_untrained)


def follows_own_past(predicted: ArrayLike, script: ArrayLike, *, scale: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns for each pair and branch (P, 2): 1 if the answer follows the past it was given, 0 the other, 1/2 tied.

    Args:
        predicted: (P, 2, H, A) answers of the policy; [p, b] given the past of branch b.
        script: (P, 2, H, A) what the script does next in the branches.
        scale: (A,) what a difference of each action entry is divided by, such as its standard deviation in the
            training data; 1 by default, a radian beside a gripper command.

    Raises:
        ValueError: shapes differ or are not (P, 2, H, A), values are not finite, or a scale is not positive.
    """
    answers, scripts = np.asarray(predicted, dtype=np.float64), np.asarray(script, dtype=np.float64)
    if answers.shape != scripts.shape or answers.ndim != 4 or answers.shape[1] != 2:
        raise ValueError(f"expected (P, 2, H, A) twice; got predicted {answers.shape} and script {scripts.shape}")
    divisors = np.ones(answers.shape[3]) if scale is None else np.asarray(scale, dtype=np.float64)
    if divisors.shape != answers.shape[3:] or not np.all(divisors > 0):
        raise ValueError(f"expected {answers.shape[3]} positive scales; got {divisors.tolist()}")
    if not (np.isfinite(answers).all() and np.isfinite(scripts).all()):
        raise ValueError("predicted and script must be finite")
    own = np.sum(((answers - scripts) / divisors) ** 2, axis=(2, 3))
    other = np.sum(((answers - scripts[:, ::-1]) / divisors) ** 2, axis=(2, 3))
    return np.where(own < other, 1.0, np.where(own > other, 0.0, 0.5))


def p_own(predicted: ArrayLike, script: ArrayLike, *, scale: ArrayLike | None = None) -> float:
    """Returns P(the action follows its own past) over all pairs and branches; see `follows_own_past`.

    Raises ValueError as that does, and if there are no pairs.
    """
    scores = follows_own_past(predicted, script, scale=scale)
    if not scores.size:
        raise ValueError("no pairs, no score")
    return float(scores.mean())
