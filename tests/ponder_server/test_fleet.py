"""Several robots on one bus and one engine: each is answered as if alone, or refused with a reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ponder_server import contract
from ponder_server.fleet import PonderFleet
from protocol import images, topics
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link

MS = 1_000_000
ROBOTS = ("r0", "r1", "r2")
Info = Callable[..., m.EpisodeInfo]


class InTurns:
    """A batching engine of ten lines: one begun query is answered a step, by an engine that answers at once."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.begun: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def begin(self, session: str, frames: tuple[contract.Frame, ...]) -> None:
        assert session not in self.begun
        self.begun[session] = frames

    def step(self, progress: contract.Progress = contract.no_progress) -> list[contract.Outcome[contract.Fire]]:
        if not self.begun:
            return []
        session = next(iter(self.begun))
        try:
            return [contract.Outcome(session, self._engine.fire(session, self.begun.pop(session)))]
        except ValueError as error:
            return [contract.Outcome(session, None, error)]


@dataclasses.dataclass
class Hall:
    """Robots, their clocks, and the one PONDER that serves them."""

    engine: InTurns
    bus: LocalBus = dataclasses.field(default_factory=LocalBus)
    latency_budget_ms: int = 1000

    def __post_init__(self) -> None:
        self.clocks = {robot: Link(self.bus, robot=robot, proc="clock") for robot in ROBOTS}
        self.streams = {
            (robot, topic.cls): link.subscribe(topic, keep=100)
            for robot, link in self.clocks.items()
            for topic in (topics.COGNITION, topics.EVENT)
        }
        link = Link(self.bus, robot=ROBOTS[0], proc="ponder")
        self.fleet = PonderFleet(
            link,
            self.engine,  # type: ignore[arg-type]
            Heartbeat(link, "test", "host/monotonic"),
            "test",
            other_robots=ROBOTS[1:],
            latency_budget_ns=self.latency_budget_ms * MS,
        )
        self.fleet.warm_up()
        self.fleet.ready()
        self.bus.add_party(self.fleet.step)

    def open(self, robot: str, info: m.EpisodeInfo) -> m.OpenReply:
        clock = self.clocks[robot]
        header = dataclasses.replace(info.header, robot=robot)
        clock.enter_episode(header.session, header.episode, header.epoch)
        request = m.OpenRequest(info=dataclasses.replace(info, header=header))
        return clock.call(topics.OPEN, "ponder", request, timeout_ns=1)  # type: ignore[no-any-return]

    def ask(self, robot: str, query: int) -> None:
        clock = self.clocks[robot]
        frame = np.full((4, 4, 3), 10 * query + ROBOTS.index(robot), np.uint8)
        pictures = images.pack({"front": frame, "wrist": frame}, m.ImageCodec.RAW)
        seen = m.Observation(tick=query, source_ns=query, proprio=np.zeros(3, np.float32), images=pictures)
        clock.publish(topics.OBSERVATION, seen, at_ns=query)
        clock.publish(topics.QUERY, m.Query(query=query, tick=query, source_ns=query), at_ns=query)

    def settle(self) -> None:
        while self.bus.run_parties():
            pass

    def said(self, robot: str, cls: type) -> list[Any]:
        return self.streams[robot, cls].drain()  # type: ignore[no-any-return]


@pytest.fixture
def hall(fake_ponder: Any) -> Hall:
    return Hall(InTurns(fake_ponder))


def test_every_robot_gets_its_own_answers(hall: Hall, episode_info: Info, paper: m.Schedule) -> None:
    for robot in ROBOTS:
        assert hall.open(robot, episode_info(paper)).error == ""  # episodes of the same name do not meet
    for query in range(2):
        for robot in ROBOTS:
            hall.ask(robot, query)
    hall.settle()
    vectors = {robot: [c.vector.tobytes() for c in hall.said(robot, m.Cognition)] for robot in ROBOTS}
    assert [len(set(vectors[robot])) for robot in ROBOTS] == [2, 2, 2]
    assert len({vector for robot in ROBOTS for vector in vectors[robot]}) == 6


def test_a_robot_that_asks_more_is_not_answered_more(hall: Hall, episode_info: Info, paper: m.Schedule) -> None:
    for robot in ROBOTS:
        hall.open(robot, episode_info(paper))
    for query in range(6):
        hall.ask("r0", query)
    for robot in ROBOTS[1:]:
        hall.ask(robot, 0)
    num_answered = {robot: 0 for robot in ROBOTS}
    for _ in range(4):
        hall.fleet.step()
        num_answered = {robot: num_answered[robot] + len(hall.said(robot, m.Cognition)) for robot in ROBOTS}
    assert num_answered == {"r0": 1, "r1": 1, "r2": 1}


def test_an_episode_that_would_break_the_budget_is_refused(
    fake_ponder: Any, episode_info: Info, paper: m.Schedule
) -> None:
    hall = Hall(InTurns(fake_ponder), latency_budget_ms=160)  # a fire takes 78 ms
    assert [bool(hall.open(robot, episode_info(paper)).error) for robot in ROBOTS] == [False, False, True]
    assert "latency budget is 160 ms" in hall.open("r2", episode_info(paper)).error
    hall.clocks["r0"].call(topics.CLOSE, "ponder", m.CloseRequest(), timeout_ns=1)
    assert hall.open("r2", episode_info(paper)).error == ""


def test_a_refused_query_is_told_to_its_robot_alone(hall: Hall, episode_info: Info, paper: m.Schedule) -> None:
    for robot in ROBOTS:
        hall.open(robot, episode_info(paper))
    hall.engine.num_tokens["r1/ep-1"] = 999
    for robot in ROBOTS:
        hall.ask(robot, 0)
    hall.settle()
    assert [len(hall.said(robot, m.Cognition)) for robot in ROBOTS] == [1, 0, 1]
    assert [[event.name for event in hall.said(robot, m.Event)] for robot in ROBOTS] == [[], ["fire_refused"], []]


def test_closing_one_robots_episode_leaves_the_others(hall: Hall, episode_info: Info, paper: m.Schedule) -> None:
    for robot in ROBOTS:
        hall.open(robot, episode_info(paper))
    hall.clocks["r1"].call(topics.CLOSE, "ponder", m.CloseRequest(), timeout_ns=1)
    assert set(hall.engine.contexts) == {"r0/ep-1", "r2/ep-1"}
    hall.ask("r0", 0)
    hall.settle()
    assert len(hall.said("r0", m.Cognition)) == 1
