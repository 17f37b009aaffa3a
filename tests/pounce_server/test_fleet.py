"""Several robots on one bus and one POUNCE: each gets the rows that it would get alone, in turns, or a reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from clock import schedules
from pounce_server.contract import Progress, Request
from pounce_server.fleet import PounceFleet
from protocol import images, topics
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link

MS = 1_000_000
Info = Callable[..., m.EpisodeInfo]


class Together:
    """A batching engine of a few lines around one that answers alone; it notes who shared a batch."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.batches: list[int] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def invoke_many(self, requests: Sequence[Request], progress: Progress) -> list[m.Floats]:
        self.batches.append(len(requests))
        if any(request.seed == 666 for request in requests):
            raise ValueError("a seed that this engine does not like")
        return [self._engine.invoke(request, progress) for request in requests]


class Hall:
    """Robots, their clocks and worlds, and the one POUNCE that serves them."""

    def __init__(self, engine: Any, robots: Sequence[str], max_rows: int = 8) -> None:
        self.bus = LocalBus()
        self.engine = Together(engine)
        self.clocks = {robot: Link(self.bus, robot=robot, proc="clock") for robot in robots}
        self.sims = {robot: Link(self.bus, robot=robot, proc="sim") for robot in robots}
        self.streams = {
            (robot, topic.cls): link.subscribe(topic, keep=100)
            for robot, link in self.clocks.items()
            for topic in (topics.CHUNK, topics.EVENT)
        }
        link = Link(self.bus, robot=robots[0], proc="pounce")
        heartbeat = Heartbeat(link, "test", "host/monotonic")
        self.fleet = PounceFleet(link, self.engine, heartbeat, "test", other_robots=robots[1:], max_batch_rows=max_rows)
        self.fleet.warm_up()
        self.fleet.ready()
        self.engine.batches.clear()
        self.bus.add_participant(self.fleet.step)

    def open(self, robot: str, info: m.EpisodeInfo) -> m.OpenReply:
        clock, sim = self.clocks[robot], self.sims[robot]
        header = dataclasses.replace(info.header, robot=robot)
        for link in (clock, sim):
            link.enter_episode(header.session, header.episode, header.epoch)
        members = tuple(m.Member(proc=link.proc, boot_id=link.boot_id) for link in (clock, sim))
        request = m.OpenRequest(info=dataclasses.replace(info, header=header), members=members)
        return clock.call(topics.OPEN, "pounce", request, timeout_ns=1)  # type: ignore[no-any-return]

    def ask(self, robot: str, invocation: int, *, seed: int = 3, shade: int = 0) -> None:
        pictures = images.pack(dict.fromkeys(("front", "wrist"), np.full((4, 4, 3), shade, np.uint8)), m.ImageCodec.RAW)
        seen = m.Observation(tick=invocation, source_ns=7, proprio=np.zeros(3, np.float32), images=pictures)
        self.sims[robot].publish(topics.OBSERVATION, seen, at_ns=7)
        asked = m.Invocation(
            invocation=invocation, tick=invocation, now_ns=7, ref_query=1, age_ns=300 * MS,
            cognition=np.ones((2, 8), np.float32), seed=seed,
        )  # fmt: skip
        self.clocks[robot].publish(topics.INVOCATION, asked, at_ns=7)

    def said(self, robot: str, cls: type) -> list[Any]:
        return self.streams[robot, cls].drain()  # type: ignore[no-any-return]


ROBOTS = ("r0", "r1", "r2")


@pytest.fixture
def hall(fake_pounce: Any, episode_info: Info, paper: m.Schedule) -> Hall:
    hall = Hall(fake_pounce, ROBOTS)
    for robot in ROBOTS:
        assert hall.open(robot, episode_info(paper)).error == ""
    return hall


def test_who_waits_together_is_answered_together(hall: Hall) -> None:
    for robot in ROBOTS:
        hall.ask(robot, 0)
    assert hall.fleet.step()
    assert [len(hall.said(robot, m.ActionChunk)) for robot in ROBOTS] == [1, 1, 1]
    assert hall.engine.batches == [3]
    assert not hall.fleet.step()


def test_a_robot_alone_is_not_kept_waiting_for_others(hall: Hall) -> None:
    hall.ask("r1", 0)
    hall.fleet.step()
    assert [len(hall.said(robot, m.ActionChunk)) for robot in ROBOTS] == [0, 1, 0]
    assert hall.engine.batches == [1]


def test_each_gets_the_rows_of_what_it_showed(hall: Hall, fake_pounce: Any, episode_info: Info) -> None:
    for shade, robot in enumerate(ROBOTS):
        hall.ask(robot, 0, shade=10 * shade)
    hall.fleet.step()
    together = [hall.said(robot, m.ActionChunk)[0].rows.tobytes() for robot in ROBOTS]
    assert len(set(together)) == 3
    for shade, robot in enumerate(ROBOTS):
        hall.ask(robot, 1, shade=10 * shade)
        hall.fleet.step()
        assert hall.said(robot, m.ActionChunk)[0].rows.tobytes() == together[shade]


@pytest.mark.parametrize("max_rows", [1, 2])
def test_a_flooding_robot_takes_no_row_from_the_others(
    fake_pounce: Any, episode_info: Info, paper: m.Schedule, max_rows: int
) -> None:
    robots = ("flood", "a", "b", "c")
    hall = Hall(fake_pounce, robots, max_rows)
    for robot in robots:
        hall.open(robot, episode_info(paper))
    asked = dict.fromkeys(robots, 0)
    answered = dict.fromkeys(robots, 0)
    for step in range(48):
        for _ in range(5):
            hall.ask("flood", asked["flood"])
            asked["flood"] += 1
        if step % 4 == 0:
            for robot in robots[1:]:
                hall.ask(robot, asked[robot])
                asked[robot] += 1
        hall.fleet.step()
        answered = {robot: answered[robot] + len(hall.said(robot, m.ActionChunk)) for robot in robots}
    assert [answered[robot] for robot in robots[1:]] == [12, 12, 12], "each was answered every time it asked"


def test_the_culprit_of_a_refused_batch_is_told_and_the_others_have_their_rows(hall: Hall) -> None:
    for robot in ROBOTS:
        hall.ask(robot, 0, seed=666 if robot == "r1" else 3)
    hall.fleet.step()
    assert [len(hall.said(robot, m.ActionChunk)) for robot in ROBOTS] == [1, 0, 1]
    assert [[event.name for event in hall.said(robot, m.Event)] for robot in ROBOTS] == [[], ["invocation_refused"], []]


def test_what_is_newer_replaces_what_has_not_been_answered(hall: Hall) -> None:
    hall.ask("r0", 0)
    (server, *_) = hall.fleet.shells
    server.step()
    hall.ask("r0", 1)
    hall.fleet.step()
    assert [chunk.invocation for chunk in hall.said("r0", m.ActionChunk)] == [1]
    assert server.num_superseded == 1


def test_a_closed_episode_leaves_nothing_to_answer(hall: Hall) -> None:
    hall.ask("r0", 0)
    hall.fleet.shells[0].step()
    hall.clocks["r0"].call(topics.CLOSE, "pounce", m.CloseRequest(), timeout_ns=1)
    hall.fleet.step()
    assert hall.engine.batches == []


def test_a_contract_counts_with_the_company(fake_pounce: Any, episode_info: Info) -> None:
    hall = Hall(fake_pounce, ROBOTS)
    admission = hall.fleet.shells[0]._admission
    admission.batch_ns = {1: 25 * MS, 2: 30 * MS, 4: 40 * MS}
    schedule = dataclasses.replace(schedules.realtime(), invoke_period_ticks=10)
    promised = [hall.open(robot, episode_info(schedule)).contract for robot in ROBOTS]
    assert [contract.infer_p99_ns // MS for contract in promised if contract] == [25, 55, 70]


def test_a_robot_too_many_is_refused_with_a_sentence_and_admitted_when_another_leaves(
    fake_pounce: Any, episode_info: Info
) -> None:
    hall = Hall(fake_pounce, ROBOTS)
    hall.fleet.shells[0]._admission.batch_ns = {1: 100 * MS, 2: 200 * MS, 4: 400 * MS}
    schedule = dataclasses.replace(schedules.realtime(), invoke_period_ticks=10)
    replies = [hall.open(robot, episode_info(schedule)) for robot in ROBOTS]
    assert [reply.error == "" for reply in replies] == [True, True, False]
    assert "with 2 others an invocation may take 600 ms" in replies[2].error
    assert replies[2].refusal == m.Refusal.BUSY
    hall.clocks["r0"].call(topics.CLOSE, "pounce", m.CloseRequest(), timeout_ns=1)
    assert hall.open("r2", episode_info(schedule)).error == ""
