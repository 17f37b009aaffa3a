"""The order of judging: failure of the current subtask, then its completion, one subtask per step."""

from __future__ import annotations

from typing import Any, cast

import pytest

from dual_system.tasks.engine import Progress, Status, judge
from dual_system.tasks.physics import Physics
from dual_system.tasks.task import Subtask

NO_PHYSICS = cast(Physics, None)  # judging only hands it on


def subtask(name: str) -> Subtask:
    """A subtask that is done, or fails, when memory says so."""
    return Subtask(
        text=name,
        is_done=lambda physics, memory: name in memory["done"],
        failure=lambda physics, memory: f"{name} went wrong" if name in memory.get("failed", ()) else None,
        motion=lambda motions: iter(()),
    )


LIST = tuple(subtask(name) for name in ("a", "b", "c"))


def step(progress: Progress, *, accomplished: bool = False, **memory: Any) -> Progress:
    return judge(progress, LIST, NO_PHYSICS, {"done": (), **memory}, is_accomplished=accomplished)


def test_at_most_one_subtask_is_passed_per_step() -> None:
    progress = step(Progress(), done="abc")
    assert progress == Progress(index=1)


def test_passing_the_last_subtask_is_success() -> None:
    progress = Progress()
    for _ in LIST:
        progress = step(progress, done="abc")
    assert progress.status is Status.SUCCESS
    assert progress.index == len(LIST)


def test_failure_comes_before_completion() -> None:
    progress = step(Progress(), done="a", failed="a")
    assert (progress.status, progress.reason, progress.index) == (Status.FAIL, "a went wrong", 0)


def test_only_the_current_subtask_can_fail() -> None:
    assert step(Progress(), failed="bc").status is Status.ONGOING
    assert step(Progress(index=1), failed="ac").status is Status.ONGOING


def test_an_accomplished_task_is_over_whatever_the_list_says() -> None:
    assert step(Progress(), accomplished=True).status is Status.SUCCESS


def test_failure_outweighs_accomplishment() -> None:
    assert step(Progress(), accomplished=True, failed="a").status is Status.FAIL


@pytest.mark.parametrize("status", [Status.SUCCESS, Status.FAIL, Status.TIMEOUT])
def test_outcomes_are_final(status: Status) -> None:
    over = Progress(index=1, status=status, reason="over")
    assert step(over, done="abc", failed="abc", accomplished=True) is over
