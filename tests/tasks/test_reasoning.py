"""What a subtask needs from the past, in words: whole sentences, true numbers, coordinates of what is seen now."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from dual_system.tasks import captions
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.environment import Environment
from dual_system.tasks.task import make_task, task_names

EnvironmentOf = Callable[[str], Environment]

every_task = pytest.mark.parametrize("name", task_names())
COUNTING = tuple(name for name in task_names() if make_task(name).family == "counting")


@every_task
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_every_subtask_s_sentence_can_be_filled(environment: EnvironmentOf, name: str, difficulty: str) -> None:
    env, task = environment(name), make_task(name)
    for seed in range(4):
        layout = task.sample(np.random.default_rng(seed), difficulty)
        for index in range(len(task.subtasks(layout))):
            needed = task.reasoning(layout, index)
            if needed is None:
                continue
            assert captions.num_coordinates(needed.text) == len(needed.grounds)
            assert "<>" not in captions.simple(needed.text)
            assert "None" not in needed.text
            assert needed.text.endswith(".")
            for body in needed.grounds:
                env.physics.model.body(body)  # raises for a body that the scene has not


@every_task
def test_something_of_the_past_is_needed_in_every_episode(name: str) -> None:
    task = make_task(name)
    layout = task.sample(np.random.default_rng(0), "hard")
    assert any(task.reasoning(layout, index) for index in range(len(task.subtasks(layout))))


@pytest.mark.parametrize("name", COUNTING)
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_completed_and_remaining_make_the_target(name: str, difficulty: str) -> None:
    task = make_task(name)
    for seed in range(20):
        layout = task.sample(np.random.default_rng(seed), difficulty)
        dones = []
        for index in range(len(task.subtasks(layout))):
            needed = task.reasoning(layout, index)
            assert needed is not None
            target, done, left = (
                sum(map(int, re.findall(r"\d+", re.split(r"[;.]", part, maxsplit=1)[0])))
                for part in re.split("; (?:completed|remaining)", captions.simple(needed.text), maxsplit=2)
            )
            assert target == done + left
            dones.append(done)
        assert dones[0] == 0
        assert dones == sorted(dones)
        assert np.all(np.diff(dones) <= 2)  # StopCube's cube can come by twice in one wait


@pytest.mark.parametrize(
    ("name", "difficulty", "index", "expected"),
    [
        ("PickXtimes", "hard", 3, "Target: 4; completed: 1; remaining: 3. Next, move the blue cube to the target."),
        ("PickXtimes", "hard", 8, "Target: 4; completed: 4; remaining: 0. Next, press the button."),
        ("SwingXtimes", "hard", 4, "Target: 3; completed: 1; remaining: 2. Next, move the green cube to the left-side"),
        ("SwingXtimes", "hard", 7, "Target: 3; completed: 3; remaining: 0. Next, put the green cube on the table."),
        (
            "BinFill",
            "hard",
            4,
            "Target: 1 red, 1 blue, 2 green; completed: 1 red, 1 green; remaining: 1 blue, 1 green.",
        ),
        ("StopCube", "hard", 2, "Target: 5; completed when this wait ends: 3; remaining: 2. One visit every 4 s."),
        ("ButtonUnmask", "hard", 0, "Reveal: the green cube, the blue cube, the red cube. Track what covers each;"),
        ("ButtonUnmask", "hard", 3, "Reveal: container H hides the green cube, G hides the blue cube, I hides the red"),
        (
            "PickHighlight",
            "hard",
            4,
            "Highlighted: the red cube, the red cube, the green cube; after 2 of 3, choose the",
        ),
    ],
)
def test_examples(name: str, difficulty: str, index: int, expected: str) -> None:
    task = make_task(name)
    needed = task.reasoning(task.sample(np.random.default_rng(0), difficulty), index)
    assert needed is not None
    assert captions.simple(needed.text).startswith(expected)


def test_a_tracked_container_keeps_its_letter(environment: EnvironmentOf) -> None:
    """Letters go by where containers stood at first; the sentence's last coordinates are where the target is now."""
    env = environment("VideoUnmaskSwap")
    env.reset(7, "medium")
    layout = env.layout
    ranks = np.argsort([spot.y_m for spot in layout.containers]).tolist()
    letter_of = {container: "ABCD"[rank] for rank, container in enumerate(ranks)}
    text = env.reasoning()
    for cube in layout.hidden:
        assert f"{letter_of[cube.container]} hides the {cube.color} cube" in text
    swaps = ", ".join(f"{letter_of[first]} <-> {letter_of[second]}" for first, second in layout.swaps)
    assert f"Track swaps {swaps}; final target is {letter_of[layout.hidden[0].container]} at <" in text


@pytest.mark.parametrize("name", ["PickXtimes", "VideoUnmaskSwap"])
def test_coordinates_are_of_now_and_the_subgoal_stands_at_the_end(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    snapshot = env.reset(7, "medium")
    text = env.reasoning()
    assert text.endswith(f" Subgoal: {snapshot.grounded_subgoal}.")
    first = re.findall(r"<\d+, \d+>", snapshot.grounded_subgoal)
    assert first[0] in text.partition(" Subgoal: ")[0]
    assert all(0 <= int(n) < 256 for pair in re.findall(r"<(\d+), (\d+)>", text) for n in pair)
