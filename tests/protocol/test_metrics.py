"""What ``/metrics`` prints is what the episode's messages say, read back by Prometheus's own parser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.samples import Sample

from clock.report import num_starved
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.drops import DropReason
from protocol.link import Link
from protocol.metrics import IDENTITY, PREFIX, End, Metrics
from protocol.topics import CHUNK, EVENT, INFO, INVOCATION, OBSERVATION, STAMP, TICK

READY = m.Health(state=m.ServingState.READY, model_hash="abc", version="1.0")


def scraped(metrics: Metrics) -> list[Sample]:
    text = generate_latest(metrics).decode()
    return [sample for family in text_string_to_metric_families(text) for sample in family.samples]


def value(metrics: Metrics, series: str, **labels: str) -> float:
    """The sum over every ``series`` that have these labels."""
    return sum(s.value for s in scraped(metrics) if s.name == PREFIX + series and s.labels.items() >= labels.items())


def end_of(link: Link, health: m.Health = READY, **changes: Any) -> End:
    return End(link=link, health=lambda: health, **{"silent_ns": lambda: 0} | changes)


@pytest.fixture
def link() -> Link:
    return Link(LocalBus(), robot="r0", proc="clock")


@pytest.fixture
def metrics(link: Link) -> Metrics:
    metrics = Metrics()
    metrics.watch(end_of(link))
    return metrics


def test_a_camera_s_age_is_that_of_the_last_tick(
    link: Link, metrics: Metrics, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    link.publish(INFO, episode_info(paper), at_ns=0)
    tick = m.Tick(tick=0, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.HOLD)
    for age_ns in (40_000_000, 90_000_000):
        link.publish(TICK, replace(tick, picture_age_ns=(age_ns, -1)), at_ns=0)
    assert value(metrics, "picture_age_seconds", camera="front") == 0.09
    assert value(metrics, "picture_age_seconds", camera="wrist") == -1


def test_an_episode_is_counted_as_its_messages_say(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    metrics = Metrics()
    for proc in ("clock", "ponder", "pounce"):
        metrics.watch(end_of(rig.links[proc]))
    rig.meanwhile = rig.listen(TICK, CHUNK, STAMP, INVOCATION)
    rig.run(episode_info(paper), 60)
    rig.meanwhile()
    ticks, invocations = rig.said[m.Tick], rig.said[m.Invocation]
    for level in {tick.level for tick in ticks}:
        expected = sum(tick.level == level for tick in ticks)
        assert value(metrics, "ticks_total", level=level.name.lower()) == expected
    assert value(metrics, "tick_late_seconds_count") == len(ticks) > 20
    assert value(metrics, "starved_ticks_total") == num_starved(ticks)
    assert value(metrics, "asked_total", kind="invocation") == len(invocations)
    assert value(metrics, "infer_seconds_count", proc="pounce") == len(rig.said[m.ActionChunk]) > 1
    assert value(metrics, "answer_delay_seconds_count", proc="clock") == len(rig.said[m.Stamp])
    oldest_ns = max(tick.age_ns for tick in ticks)
    assert value(metrics, "cognition_age_seconds_bucket", le="5.0") == value(metrics, "cognition_age_seconds_count") > 0
    assert oldest_ns < 5e9


@pytest.mark.parametrize(("rows", "starved"), [((1, 1, 0, 0), 2), ((0, 1, 0), 1), ((0, 0), 0)])
def test_a_tick_is_starved_without_a_row_once_one_was_played(
    link: Link, metrics: Metrics, rows: tuple[int, ...], starved: int
) -> None:
    tick = m.Tick(tick=0, deadline_ns=0, decided_ns=0, late_ns=0, level=m.Level.HOLD)
    for number, has_row in enumerate(rows):
        level = m.Level.PLAY if has_row else m.Level.HOLD
        link.publish(TICK, replace(tick, tick=number, level=level, raw_row=np.zeros(has_row, np.float32)), at_ns=0)
    assert value(metrics, "starved_ticks_total") == starved


def test_every_series_says_whose_it_is(link: Link, metrics: Metrics) -> None:
    link.drop("sim", DropReason.STRANGER, "")
    link.publish(EVENT, m.Event(severity=m.Severity.ERROR, name="sim_lost", text="gone"), at_ns=0)
    samples = scraped(metrics)
    assert {"process_resident_memory_bytes", f"{PREFIX}ready"} <= {sample.name for sample in samples}
    identity = {"proc": "clock", "robot": "r0", "model_hash": "abc", "build": "1.0"}
    assert [s for s in samples if {k: s.labels.get(k) for k in IDENTITY} != identity] == []


def test_drops_and_events_are_counted_by_their_names(link: Link, metrics: Metrics) -> None:
    link.drop("sim", DropReason.STRANGER, "")
    link.publish(EVENT, m.Event(severity=m.Severity.ERROR, name="sim_lost", text="gone"), at_ns=0)
    assert value(metrics, "dropped_total", reason="stranger") == 1
    assert value(metrics, "events_total", name="sim_lost", severity="error") == 1


def test_a_message_that_a_newer_one_pushed_out_is_superseded(link: Link, metrics: Metrics) -> None:
    observations = link.subscribe(OBSERVATION, keep=1)
    sender = Link(link.bus, robot="r0", proc="sim")
    for tick in range(3):
        seen = m.Observation(tick=tick, source_ns=tick, proprio=np.zeros(3, np.float32))
        sender.publish(OBSERVATION, seen, at_ns=tick)
    assert value(metrics, "superseded_total", queue="obs") == 2
    observations.drain()
    assert value(metrics, "superseded_total", queue="obs") == 2


def test_a_server_s_warm_up_is_there_from_its_heartbeat(link: Link) -> None:
    metrics = Metrics()
    health = replace(READY, infer_p50_ns=25_000_000, infer_p99_ns=40_000_000, num_answered=7)
    metrics.watch(end_of(link, health))
    assert value(metrics, "warm_infer_seconds", quantile="0.99") == 0.04
    assert value(metrics, "answered_total") == 7


def test_counts_of_another_model_are_other_series(link: Link) -> None:
    health = READY
    metrics = Metrics()
    metrics.watch(End(link=link, health=lambda: health, silent_ns=lambda: 0))
    event = m.Event(severity=m.Severity.INFO, name="warning", text="")
    link.publish(EVENT, event, at_ns=0)
    health = replace(READY, model_hash="def")
    link.publish(EVENT, event, at_ns=0)
    assert value(metrics, "events_total", model_hash="abc") == value(metrics, "events_total", model_hash="def") == 1


def test_robots_of_one_process_are_series_of_their_own() -> None:
    bus, metrics = LocalBus(), Metrics()
    for robot in ("r0", "r1"):
        metrics.watch(end_of(Link(bus, robot=robot, proc="ponder")))
    assert {s.labels["robot"] for s in scraped(metrics) if s.name == f"{PREFIX}ready"} == {"r0", "r1"}


@pytest.mark.parametrize(
    ("changes", "hang", "unready"),
    [
        ({}, "", ""),
        ({"silent_ns": lambda: 11_000_000_000}, "silent for 11 s", "silent for 11 s"),
        ({"health": m.Health(state=m.ServingState.LOADING, progress=0.5, detail="x")}, "", "loading (50%) x"),
    ],
)
def test_a_hung_loop_is_unhealthy_and_loading_is_only_not_ready(
    link: Link, changes: dict[str, Any], hang: str, unready: str
) -> None:
    end = end_of(link, **changes)
    for text, expected in ((end.hang, hang), (end.unready, unready)):
        assert expected in text
        assert bool(expected) is bool(text)
