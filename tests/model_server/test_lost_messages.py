"""In lockstep a message that a broken link swallowed costs time and nothing else: every command is the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from model_server import membership
from protocol import messages as m
from protocol import topics
from protocol.bus import LocalBus
from protocol.topics import Priority


class LossyBus(LocalBus):
    """Swallows the messages of one topic with the given numbers, and what the servers should see at the same tick."""

    def __init__(self, lost: dict[str, range]) -> None:
        super().__init__()
        self._lost = lost
        self._counts: dict[str, int] = {}
        self.num_swallowed = 0

    def publish(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, priority: Priority) -> None:
        name = key.split("/")[5] if "/ep/" in key else ""
        number = self._counts.get(name, 0)
        self._counts[name] = number + 1
        if number in self._lost.get(name, range(0)):
            self.num_swallowed += 1
            return
        super().publish(key, payload, encoding=encoding, attachment=attachment, priority=priority)


@pytest.mark.parametrize(
    "lost",
    [
        {topics.QUERY.name: range(1, 3)},
        {topics.INVOCATION.name: range(1, 3)},
        {topics.COGNITION.name: range(1, 3)},
        {topics.CHUNK.name: range(1, 4)},
        {topics.QUERY.name: range(2, 3), topics.INVOCATION.name: range(2, 3), topics.CHUNK.name: range(3, 4)},
    ],
    ids=["query", "invocation", "cognition", "chunk", "several"],
)
def test_what_was_swallowed_is_asked_for_again(
    new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule,
    monkeypatch: pytest.MonkeyPatch, lost: dict[str, range],
) -> None:  # fmt: skip
    _, undisturbed = new_rig().run(episode_info(paper), 100)
    monkeypatch.setattr(membership, "_LOST_REQUEST_NS", 0)
    monkeypatch.setattr(membership, "_ASK_AGAIN_NS", 0)
    bus = LossyBus(lost)
    outcome, disturbed = new_rig(bus=bus).run(episode_info(paper), 100)
    assert outcome.status == m.TaskStatus.SUCCESS
    assert bus.num_swallowed == sum(map(len, lost.values()))
    assert disturbed.commands == undisturbed.commands


def test_in_real_time_nothing_is_asked_for(rig: Any, episode_info: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from clock import schedules

    monkeypatch.setattr(membership, "_LOST_REQUEST_NS", 0)
    rig.enter(episode_info(schedules.realtime()))
    assert rig.pounce._membership.owed() is None
    assert rig.ponder._membership.owed() is None
