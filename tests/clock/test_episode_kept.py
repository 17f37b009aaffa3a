"""What the clock keeps of an open episode is bounded, however long it lasts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from clock.episode import MAX_RECENT_BYTES, Episode
from protocol import messages as m


def test_a_long_episode_keeps_no_more_than_a_restarted_pounce_is_told() -> None:
    payloads = [bytes([index]) * (5 << 20) for index in range(20)]
    request: Any = SimpleNamespace(info=SimpleNamespace(schedule=SimpleNamespace(mode=m.Mode.LOCKSTEP)))
    conductor: Any = SimpleNamespace(picture_stride_ticks=2)
    episode = Episode(request, conductor)
    for tick, payload in enumerate(payloads):
        episode.show(tick, payload)
    kept = list(episode.remembered)
    assert kept == payloads[::2][-len(kept) :]
    assert MAX_RECENT_BYTES - (5 << 20) < sum(map(len, kept)) <= MAX_RECENT_BYTES
    assert list(episode.past()) == kept
