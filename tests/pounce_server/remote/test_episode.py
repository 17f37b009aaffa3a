"""A whole episode with a policy server behind POUNCE: its rows are played, its faults are told and move nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.openpi import OpenpiPeer
from protocol import messages as m
from protocol import topics
from protocol.peers.mapping import PolicyMapping

Info = Callable[..., m.EpisodeInfo]


def rows_in(world: Any) -> np.ndarray:
    return np.array([np.frombuffer(command, np.float32) for command in world.commands])


@pytest.fixture
def rig_with(new_rig: Callable[..., Any], openpi_server: Any, mapping: PolicyMapping) -> Callable[..., Any]:
    def make(**changes: Any) -> Any:
        mapped = dataclasses.replace(mapping, **changes)
        peer = OpenpiPeer(openpi_server.url, mapped)
        return new_rig(pounce_engine=RemoteEngine(peer, mapped, openpi_server.url, answer_s=0.5, start_s=5))

    return make


def test_the_policys_rows_are_played(rig_with: Any, openpi_server: Any, episode_info: Info, paper: m.Schedule) -> None:
    def script(seen: dict[str, Any]) -> Any:
        return {"actions": seen["state"] + 0.01 * (1 + np.arange(20, dtype=np.float32))[:, None] * [1, 0, -1]}

    openpi_server.policy.script = script
    _, world = rig_with().run(episode_info(paper), 45)
    commands = rows_in(world)
    np.testing.assert_allclose(np.diff(commands[1:20], axis=0), np.tile([0.01, 0, -0.01], (18, 1)), atol=1e-6)


def test_an_episode_of_a_policy_of_another_rate_is_refused(
    rig_with: Any, episode_info: Info, paper: m.Schedule
) -> None:
    reply = rig_with(rate_hz=15, play_hz=15).open(episode_info(paper))
    assert (reply.refusal, reply.try_again) == (m.Refusal.SCHEDULE, False)
    assert "mapped for 15 rows a second, the episode plays 20" in reply.error


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda: {"actions": np.full((20, 3), np.nan)}, "nan in row 0"),
        (lambda: {"actions": np.zeros((20, 7))}, r"is (20, 7)"),
        (lambda: "Traceback: out of memory", "it says: Traceback: out of memory"),
    ],
)
def test_a_wrong_answer_is_an_event_and_the_next_right_one_is_played(
    rig_with: Any, openpi_server: Any, episode_info: Info, paper: m.Schedule, answer: Callable[[], Any], said: str
) -> None:
    rig = rig_with()
    take = rig.listen(topics.EVENT, topics.CHUNK)
    asked = [0]

    def script(seen: dict[str, Any]) -> Any:
        asked[0] += 1
        return answer() if asked[0] == 2 else {"actions": openpi_server.policy.held(seen)}

    openpi_server.policy.script = script
    _, world = rig.run(episode_info(paper), 45)
    take()
    (refused,) = (e.text for e in rig.said[m.Event] if e.name == "invocation_refused")
    assert said in refused
    assert [chunk.invocation for chunk in rig.said[m.ActionChunk]] == [0, 1, 2]
    assert np.isfinite(rows_in(world)).all()


def test_a_server_that_is_gone_refuses_the_episode_and_may_be_tried_again(
    rig_with: Any, openpi_server: Any, episode_info: Info, paper: m.Schedule
) -> None:
    rig = rig_with()
    openpi_server.metadata = {"another": "model"}
    openpi_server.connections[-1].close_socket()
    rig.pounce_engine._peer.close()
    reply = rig.open(episode_info(paper))
    assert (reply.refusal, reply.try_again) == (m.Refusal.NOT_READY, True)
    assert f"policy server {openpi_server.url}" in reply.error
