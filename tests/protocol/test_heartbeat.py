"""A heartbeat comes at most every 100 ms, but news comes at once; it stops when nobody calls it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

from protocol import topics
from protocol.bus import LocalBus
from protocol.drops import DropReason
from protocol.heartbeat import PERIOD_NS, Heartbeat
from protocol.link import Link, Stream
from protocol.messages import Health, ServingState

MS = 1_000_000


@dataclass
class Monotonic:
    """``time.monotonic_ns``, moved by hand."""

    now_ns: int = 5_000 * MS


@pytest.fixture
def monotonic(monkeypatch: pytest.MonkeyPatch) -> Monotonic:
    clock = Monotonic()
    monkeypatch.setattr(time, "monotonic_ns", lambda: clock.now_ns)
    return clock


@pytest.fixture
def link() -> Link:
    return Link(LocalBus(), robot="r0", proc="ponder")


@pytest.fixture
def healths(link: Link) -> Stream[Health]:
    return link.subscribe(topics.HEALTH)


@pytest.fixture
def heartbeat(link: Link, healths: Stream[Health], monotonic: Monotonic) -> Heartbeat:
    return Heartbeat(link, "1.2", "host/monotonic")


def test_a_heartbeat_declares_the_process_alive(link: Link, heartbeat: Heartbeat) -> None:
    (token,) = link.bus.watch_alive(topics.alive_key("r0", "*")).drain()
    assert token.key.endswith("alive/ponder")


def test_the_first_beat_is_sent(heartbeat: Heartbeat, healths: Stream[Health]) -> None:
    heartbeat.beat()
    (health,) = healths.drain()
    assert (health.state, health.version, health.header.clock_id) == (ServingState.LOADING, "1.2", "host/monotonic")


@pytest.mark.parametrize(("after_ns", "expected"), [(PERIOD_NS - 1, 0), (PERIOD_NS, 1)])
def test_the_next_beat_waits_for_its_period(
    heartbeat: Heartbeat, healths: Stream[Health], monotonic: Monotonic, after_ns: int, expected: int
) -> None:
    heartbeat.beat()
    healths.drain()
    monotonic.now_ns += after_ns
    heartbeat.beat()
    assert len(healths.drain()) == expected


def test_a_thousand_calls_a_second_are_ten_beats(
    heartbeat: Heartbeat, healths: Stream[Health], monotonic: Monotonic
) -> None:
    for _ in range(1_000):
        heartbeat.beat()
        monotonic.now_ns += MS
    assert len(healths.drain()) == 10


@pytest.mark.parametrize("news", [{"state": ServingState.READY}, {"open_episode": "e1"}])
def test_news_is_sent_at_once(heartbeat: Heartbeat, healths: Stream[Health], news: dict[str, object]) -> None:
    heartbeat.beat()
    healths.drain()
    heartbeat.set(**news)
    (health,) = healths.drain()
    assert {name: getattr(health, name) for name in news} == news


def test_what_is_no_news_waits_for_the_next_beat(
    heartbeat: Heartbeat, healths: Stream[Health], monotonic: Monotonic
) -> None:
    heartbeat.beat()
    healths.drain()
    heartbeat.set(next_index=4)
    assert healths.drain() == []
    monotonic.now_ns += PERIOD_NS
    heartbeat.beat()
    assert [health.next_index for health in healths.drain()] == [4]


def test_a_beat_reports_what_the_link_dropped(link: Link, heartbeat: Heartbeat, healths: Stream[Health]) -> None:
    link.drop("somebody", DropReason.MALFORMED, "")
    heartbeat.beat()
    assert healths.drain()[0].dropped == {"malformed": 1}
