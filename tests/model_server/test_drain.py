"""Draining: the running episode ends as it would have, no other begins, and then the process may leave."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from protocol import messages as m

Info = Callable[..., m.EpisodeInfo]


def drain(rig: Any, proc: str) -> bool:
    return bool(getattr(rig, proc).drain())


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_without_an_episode_it_may_leave_at_once(rig: Any, proc: str) -> None:
    assert drain(rig, proc)


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_the_running_episode_is_finished_first(rig: Any, episode_info: Info, paper: m.Schedule, proc: str) -> None:
    asked: list[bool] = []
    rig.meanwhile = lambda: asked.append(drain(rig, proc))
    _, world = rig.run(episode_info(paper), 30)
    assert len(world.commands) == 30
    assert asked
    assert not any(asked)
    assert rig.clock.close(m.CloseRequest(header=rig.links["sim"].header("close", 0))).error == ""
    rig.settle()
    assert drain(rig, proc)


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_the_next_episode_is_refused_and_may_be_tried_again(
    rig: Any, episode_info: Info, paper: m.Schedule, proc: str
) -> None:
    drain(rig, proc)
    reply = rig.open(episode_info(paper))
    assert (reply.refusal, reply.try_again) == (m.Refusal.NOT_READY, True)
    assert "draining" in reply.error
    assert drain(rig, proc)


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_a_robot_that_starts_again_ends_its_old_episode(
    rig: Any, episode_info: Info, paper: m.Schedule, proc: str
) -> None:
    rig.enter(episode_info(paper))
    assert not drain(rig, proc)
    assert rig.open(episode_info(paper, epoch=2)).refusal == m.Refusal.NOT_READY
    rig.settle()
    assert drain(rig, proc)
