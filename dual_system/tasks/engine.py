"""Where an episode stands: an ordered list of subtasks, judged once per control step.

Failure of the current subtask is looked at first, then its completion; at most one subtask is passed per step.
Failures of other subtasks do not count while they are not current. Outcomes are final.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from dual_system.tasks.physics import Physics
from dual_system.tasks.task import Subtask


class Status(enum.Enum):
    """How an episode stands."""

    ONGOING = "ongoing"
    SUCCESS = "success"
    FAIL = "fail"
    TIMEOUT = "timeout"


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The current subtask and the outcome so far; ``reason`` is why an episode ended."""

    index: int = 0
    status: Status = Status.ONGOING
    reason: str = ""
    first_choice: bool | None = None  # whether the first one was right, see `Task.first_choice`; it decides nothing


def judge(
    progress: Progress, subtasks: Sequence[Subtask], physics: Physics, memory: Any, *, is_accomplished: bool
) -> Progress:
    """Returns the progress after one more control step.

    ``is_accomplished`` is the task's own verdict on the whole episode, for tasks that can be over before the list is.
    """
    if progress.status is not Status.ONGOING:
        return progress
    current = subtasks[progress.index]
    reason = current.failure(physics, memory)
    if reason is not None:
        return replace(progress, status=Status.FAIL, reason=reason)
    index = progress.index + bool(current.is_done(physics, memory))
    if is_accomplished:
        return replace(progress, index=index, status=Status.SUCCESS, reason="task accomplished")
    if index == len(subtasks):
        return replace(progress, index=index, status=Status.SUCCESS, reason="all subtasks completed")
    return replace(progress, index=index)
