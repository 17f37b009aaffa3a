"""``norm_stats.json``: quantiles of state and action, and the delta mask, found by name wherever they are nested.

Public: the file holds quantiles q01 and q99 of both, and a mask of the action dims that are relative. Its keys are not.
Means and other moments are not read; a number that this file does not know is refused, because it could be part of the
normalisation.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.official.header import FolderError

JOINT_DELTAS = (True,) * (ROBOT_DIM - 1) + (False,)
UNREAD = {"mean", "std", "min", "max", "count", "var", "num_samples"}
WAY_OUT = "Attach norm_stats.json to an issue; a guessed normalisation would move the robot wrongly."


@dataclass(frozen=True, slots=True)
class ReadStatistics:
    statistics: RobotStatistics
    notes: tuple[str, ...]
    """What was not read, and dims beyond the robot's, one sentence each."""


def read_statistics(path: Path) -> ReadStatistics:
    """Reads a ``norm_stats.json``.

    Raises:
        FileNotFoundError: it is not there.
        FolderError: quantiles or the mask are missing or ambiguous, the mask is not seven deltas and an absolute
            gripper, or a number is unknown.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: not there; without it no action has a unit.")
    try:
        leaves = dict(_leaves(json.loads(path.read_text())))
    except ValueError as error:
        raise FolderError(f"{path}: no JSON: {error}") from error
    notes: list[str] = []
    tables: dict[str, list[float]] = {}
    masks: dict[str, list[bool]] = {}
    for name, value in leaves.items():
        leaf, where = name.rpartition(".")[2], name.lower()
        if leaf in ("q01", "q99") and _is_numbers(value):
            sides = [side for side, words in _SIDES.items() if any(word in where for word in words)]
            if len(sides) != 1 or f"{sides[0]}.{leaf}" in tables:
                raise FolderError(f"{path}: {name}: expected one {leaf} of the state and one of the action. {WAY_OUT}")
            tables[f"{sides[0]}.{leaf}"] = [float(each) for each in value]
        elif isinstance(value, list) and value and all(isinstance(each, bool) for each in value):
            masks[name] = value
        elif isinstance(value, str) or leaf in UNREAD:
            notes.append(f"{name} is not read")
        else:
            raise FolderError(f"{path}: {name}: unknown, came {str(value)[:80]}. {WAY_OUT}")
    missing = [f"{side}.{leaf}" for side in _SIDES for leaf in ("q01", "q99") if f"{side}.{leaf}" not in tables]
    if missing or len(masks) != 1:
        raise FolderError(
            f"{path}: expected q01 and q99 of state and action and one list of booleans (the delta mask), came "
            f"{sorted(leaves)}. {WAY_OUT}"
        )
    ((mask_name, mask),) = masks.items()
    if tuple(mask[:ROBOT_DIM]) != JOINT_DELTAS or any(mask[ROBOT_DIM:]):
        raise FolderError(
            f"{path}: {mask_name}: expected seven true (joints relative to the state) and false (the gripper), came "
            f"{mask}. Our action spaces have no other; see `models.action_space`."
        )
    for name, values in tables.items():
        if len(values) < ROBOT_DIM:
            raise FolderError(f"{path}: {name}: expected at least {ROBOT_DIM} dims, came {len(values)}. {WAY_OUT}")
        if len(values) > ROBOT_DIM:
            notes.append(f"{name} has {len(values)} dims, of which the first {ROBOT_DIM} are the robot's")
    state, action = (
        Quantiles(q01=tuple(tables[f"{side}.q01"][:ROBOT_DIM]), q99=tuple(tables[f"{side}.q99"][:ROBOT_DIM]))
        for side in _SIDES
    )
    return ReadStatistics(RobotStatistics(state=state, action=action), tuple(notes))


_SIDES = {"state": ("state", "proprio"), "action": ("action",)}


def _is_numbers(value: Any) -> bool:
    return isinstance(value, list) and all(type(each) in (int, float) for each in value)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything that is no object."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, value
