"""The oracle's episode, told in tool deltas and back, still succeeds: nothing that a task needs is lost in between."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dual_system.models.action_space import actions_in, targets_from
from dual_system.models.arm import tool_poses
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment

ROWS = 20  # of a chunk, played whole


def recorded(env: Environment, seed: int, difficulty: str) -> tuple[np.ndarray, np.ndarray]:
    """States (T, 8) and the oracle's commands (T, 8)."""
    states, commands = [env.reset(seed, difficulty).state], []
    for action in env.oracle():
        commands.append(action)
        snapshot = env.step(action, look=False)
        if snapshot.status is not Status.ONGOING:
            assert snapshot.status is Status.SUCCESS
            return np.array(states), np.array(commands)
        states.append(snapshot.state)
    raise AssertionError("the oracle did not end the episode")


@pytest.mark.parametrize(
    ("task", "seed", "difficulty"),
    [
        ("PickHighlight", 0, "easy"),
        ("PickHighlight", 1, "medium"),
        pytest.param("PickHighlight", 2, "hard", marks=pytest.mark.acceptance),
        ("PatternLock", 0, "easy"),
    ],
)
def test_an_episode_told_in_tool_deltas_still_succeeds(
    environment: Callable[[str], Environment], task: str, seed: int, difficulty: str
) -> None:
    env = environment(task)
    states, commands = recorded(env, seed, difficulty)
    snapshot = env.reset(seed, difficulty)
    for first in range(0, len(commands), ROWS):
        rows = np.minimum(first + np.arange(ROWS), len(commands) - 1)
        actions = actions_in("ee_delta", commands, states[[first]], rows[None])[0]
        again = targets_from("ee_delta", actions.astype(np.float32), states[first])
        there, came = tool_poses(commands[rows, :7]), tool_poses(again[:, :7])
        assert np.linalg.norm(came.position_m - there.position_m, axis=-1).max() < 1e-4
        for row in targets_from("ee_delta", actions, snapshot.state).astype(np.float32):  # from where this arm is
            snapshot = env.step(row, look=False)
            if snapshot.status is not Status.ONGOING:
                break
    assert snapshot.status is Status.SUCCESS, snapshot.reason
