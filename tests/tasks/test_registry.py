"""Tasks are found by name; a wrong name is answered with the nearest right one."""

from __future__ import annotations

import pytest

from dual_system.tasks.task import FAMILIES, Task, TaskError, make_task, task, task_names


def test_every_listed_task_can_be_made() -> None:
    for name in task_names():
        made = make_task(name)
        assert made.name == name
        assert made.family in FAMILIES


def test_pick_highlight_is_listed() -> None:
    assert "PickHighlight" in task_names()


def test_a_near_miss_gets_a_suggestion() -> None:
    with pytest.raises(TaskError) as error:
        make_task("PickHighlights")
    assert str(error.value) == (
        "unknown task 'PickHighlights'. Did you mean 'PickHighlight'? sim-client --list-tasks shows all."
    )


def test_a_far_miss_gets_none() -> None:
    with pytest.raises(TaskError) as error:
        make_task("Zzz")
    assert str(error.value) == "unknown task 'Zzz'. sim-client --list-tasks shows all."


def test_a_name_cannot_be_taken_twice() -> None:
    task_names()
    with pytest.raises(TaskError, match="'PickHighlight' is defined in both"):

        @task(family="reference")
        class PickHighlight(Task):  # type: ignore[type-arg]
            pass


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(TaskError, match="unknown task family 'cooking'"):
        task(family="cooking")
