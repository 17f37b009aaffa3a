"""Several robots on one bus and one engine: each is answered as if alone, or refused with a reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from clock import schedules
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server import contract
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.fleet import PonderFleet
from protocol import codec, images, topics
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link

MS = 1_000_000
ROBOTS = ("r0", "r1", "r2")
Info = Callable[..., m.EpisodeInfo]


class InTurns:
    """A batching engine of ten lines: one begun query is answered a step, by an engine that answers at once."""

    def __init__(self, engine: Any, *, full_ms: int = 78) -> None:
        self._engine = engine
        self._full_ms = full_ms
        self.begun: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def warm_up_full(self) -> list[int]:
        return [self._full_ms * MS] * 10

    def open(self, session: str, opening: contract.Opening, progress: Any, between: Any) -> int:
        return self._engine.open(session, opening, progress)  # type: ignore[no-any-return]

    def begin(
        self, session: str, frames: tuple[contract.Frame, ...], *, proprio: contract.Proprio | None = None
    ) -> None:
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

    engine: Any
    px: int = 4
    bus: LocalBus = dataclasses.field(default_factory=LocalBus)

    def __post_init__(self) -> None:
        self.clocks = {robot: Link(self.bus, robot=robot, proc="clock") for robot in ROBOTS}
        self.sims = {robot: Link(self.bus, robot=robot, proc="sim") for robot in ROBOTS}
        self.streams = {
            (robot, topic.cls): link.subscribe(topic, keep=100)
            for robot, link in self.clocks.items()
            for topic in (topics.COGNITION, topics.EVENT)
        }
        link = Link(self.bus, robot=ROBOTS[0], proc="ponder")
        heartbeat = Heartbeat(link, "test", "host/monotonic")
        self.fleet = PonderFleet(link, self.engine, heartbeat, "test", other_robots=ROBOTS[1:])
        self.fleet.warm_up()
        self.fleet.ready()
        self.bus.add_participant(self.fleet.step)
        self.requests: dict[str, m.OpenRequest] = {}
        self.journals: dict[str, list[m.JournalEntry]] = {robot: [] for robot in ROBOTS}
        self.calls = [
            (robot, clock.serve(topics.ACTIVE), clock.serve(topics.JOURNAL)) for robot, clock in self.clocks.items()
        ]
        self.bus.add_participant(self.answer)

    def answer(self) -> bool:
        """What the clock services answer to a PONDER that knows nothing."""
        num_answered = 0
        for robot, active, journal in self.calls:
            entries = tuple(self.journals[robot])
            num_answered += active.answer(partial(running, self.requests.get(robot), len(entries)))
            num_answered += journal.answer(partial(page, entries))
        return num_answered > 0

    def open(self, robot: str, info: m.EpisodeInfo) -> m.OpenReply:
        clock = self.clocks[robot]
        header = dataclasses.replace(info.header, robot=robot)
        for link in (clock, self.sims[robot]):
            link.enter_episode(header.session, header.episode, header.epoch)
        members = tuple(m.Member(proc=link.proc, boot_id=link.boot_id) for link in (clock, self.sims[robot]))
        cameras = dataclasses.replace(info.robot, image_height=self.px, image_width=self.px)
        request = m.OpenRequest(info=dataclasses.replace(info, header=header, robot=cameras), members=members)
        self.requests[robot] = request
        return clock.call(topics.OPEN, "ponder", request, timeout_ns=1)  # type: ignore[no-any-return]

    def ask(self, robot: str, query: int) -> None:
        clock = self.clocks[robot]
        frame = np.full((self.px, self.px, 3), 10 * query + ROBOTS.index(robot), np.uint8)
        frame[: query + 1, ::2] += 40
        pictures = images.pack({"front": frame, "wrist": frame}, m.ImageCodec.RAW)
        seen = m.Observation(tick=query, source_ns=query, proprio=np.zeros(3, np.float32), images=pictures)
        entry = m.JournalEntry(query=query, tick=query, source_ns=query, observation=codec.encode(seen))
        self.journals[robot].append(entry)
        self.sims[robot].publish(topics.OBSERVATION, seen, at_ns=query)
        clock.publish(topics.QUERY, m.Query(query=query, tick=query, source_ns=query), at_ns=query)

    def forget(self, robot: str) -> None:
        """PONDER loses this robot's episode, and may ask for it at once."""
        self.clocks[robot].call(topics.CLOSE, "ponder", m.CloseRequest(), timeout_ns=1)
        (server,) = [server for server in self.fleet._servers if server._link.robot == robot]
        server._membership._ask_again_ns = 0

    def settle(self) -> None:
        while self.bus.run_participants():
            pass

    def said(self, robot: str, cls: type) -> list[Any]:
        return self.streams[robot, cls].drain()  # type: ignore[no-any-return]


def running(request: m.OpenRequest | None, num_queries: int, _: m.ActiveRequest) -> m.ActiveReply:
    return m.ActiveReply(open=request, num_queries=num_queries)


def page(entries: tuple[m.JournalEntry, ...], asked: m.JournalRequest) -> m.JournalReply:
    return m.JournalReply(entries=entries[asked.first_query : asked.first_query + asked.max_queries])


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


@pytest.mark.parametrize(
    ("full_ms", "is_refused"), [(53, [False] * 3), (78, [False, False, True]), (81, [False, True, True])]
)
def test_an_episode_with_which_a_cognition_would_grow_too_old_is_refused(
    fake_ponder: Any, episode_info: Info, full_ms: int, is_refused: list[bool]
) -> None:
    hall = Hall(InTurns(fake_ponder, full_ms=full_ms))
    schedule = dataclasses.replace(schedules.realtime(), max_age_ns=1160 * MS)
    replies = {robot: hall.open(robot, episode_info(schedule)) for robot in ROBOTS}
    assert [bool(reply.error) for reply in replies.values()] == is_refused
    for robot, reply in replies.items():
        if reply.error:
            assert "older than its --max-age-ms 1160" in reply.error
            hall.clocks["r0"].call(topics.CLOSE, "ponder", m.CloseRequest(), timeout_ns=1)
            assert hall.open(robot, episode_info(schedule)).error == ""
            break


def test_in_lockstep_the_world_waits_and_nobody_is_refused(
    fake_ponder: Any, episode_info: Info, paper: m.Schedule
) -> None:
    hall = Hall(InTurns(fake_ponder, full_ms=5000))
    assert [hall.open(robot, episode_info(paper)).error for robot in ROBOTS] == [""] * 3


def test_a_long_opening_stops_nobody(hall: Hall, episode_info: Info, paper: m.Schedule) -> None:
    """Between its forwards the others are answered, and every heartbeat goes on within them."""
    hall.open("r1", episode_info(paper))
    heard = {robot: Link(hall.bus, robot=robot, proc="ear").subscribe(topics.HEALTH, keep=100) for robot in ROBOTS}
    answered: list[int] = []
    plain_open = hall.engine.open

    def opens_in_forwards(session: str, opening: Any, progress: Any, between: Any) -> int:
        for query in range(3):
            hall.ask("r1", query)
            for server in hall.fleet.shells:
                server.heartbeat._next_ns = 0
            progress()
            for _ in range(2):  # one begins a query, one answers it
                between()
            answered.append(len(hall.said("r1", m.Cognition)))
        return plain_open(session, opening, progress, between)  # type: ignore[no-any-return]

    hall.engine.open = opens_in_forwards
    assert hall.open("r0", episode_info(paper)).error == ""
    assert answered == [1, 1, 1]
    assert all(len(stream.drain()) >= 3 for stream in heard.values())


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


def test_while_one_context_is_rebuilt_the_others_take_turns_with_it(
    hall: Hall, episode_info: Info, paper: m.Schedule
) -> None:
    for robot in ROBOTS:
        hall.open(robot, episode_info(paper))
    for query in range(9):
        hall.ask("r1", query)
        hall.settle()
    hall.forget("r1")
    hall.ask("r1", 9)
    for query in range(3):  # a rebuilding of ten queries, and three of each of the others beside it
        for robot in ("r0", "r2"):
            hall.ask(robot, query)
        for _ in range(5):
            hall.bus.run_participants()
        assert [len(hall.said(robot, m.Cognition)) for robot in ("r0", "r2")] == [1, 1]
        assert hall.said("r1", m.Event) == []
    hall.settle()
    assert [event.name for event in hall.said("r1", m.Event)] == ["context_rebuilt"]


def test_a_rebuilt_context_is_the_lost_one_and_what_was_asked_meanwhile_is_answered(
    fake_ponder: Any, episode_info: Info, paper: m.Schedule
) -> None:
    vectors = []
    for is_lost in (False, True):
        hall = Hall(InTurns(dataclasses.replace(fake_ponder, contexts={}, num_tokens={})))
        hall.open("r1", episode_info(paper))
        for query in range(8):
            hall.ask("r1", query)
            if query in (3, 7):
                hall.settle()
            if query == 3 and is_lost:
                hall.forget("r1")
            hall.bus.run_participants()
        events = [event.name for event in hall.said("r1", m.Event)]
        assert events == ["context_rebuilt"] * is_lost
        vectors.append({c.query: c.vector.tobytes() for c in hall.said("r1", m.Cognition)})
    unasked = set(range(8)) - vectors[1].keys()
    assert unasked <= {4}, "the query that woke it is in the journal, so nobody waits for its answer"
    assert all(vectors[0][query] == vector for query, vector in vectors[1].items())


def test_a_journal_that_does_not_answer_ends_that_robots_episode_only(
    hall: Hall, episode_info: Info, paper: m.Schedule
) -> None:
    for robot in ROBOTS:
        hall.open(robot, episode_info(paper))
    hall.ask("r1", 0)
    hall.settle()
    hall.forget("r1")
    hall.journals["r1"][0] = dataclasses.replace(hall.journals["r1"][0], observation=b"\xff")
    for robot in ROBOTS:
        hall.ask(robot, 1)
    hall.settle()
    assert [len(hall.said(robot, m.Cognition)) for robot in ROBOTS] == [1, 1, 1]
    assert set(hall.engine.contexts) == {"r0/ep-1", "r2/ep-1"}


def test_the_loss_of_one_context_changes_no_bit_of_the_others(episode_info: Info, paper: m.Schedule) -> None:
    """The tiny network: one robot's context is lost and thought over again, in common forwards with the others."""
    ponder = Ponder.random(dataclasses.replace(tiny_cpu(), image_px=(64, 64)), seed=1)
    vectors: list[dict[tuple[str, int], bytes]] = []
    for lost_before in (None, 3):
        engine = QwenEngine(ponder, EngineConfig(max_context_tokens=400, max_sessions=4, max_text_tokens=8))
        engine.warm_up = lambda: [MS]  # type: ignore[method-assign]
        hall = Hall(engine, px=64)
        for robot in ROBOTS:
            assert hall.open(robot, episode_info(paper)).error == ""
        said = []
        for query in range(6):
            if query == lost_before:
                hall.forget("r1")
            for robot in ROBOTS:
                hall.ask(robot, query)
            hall.bus.run_participants()  # a loss is still being made good when the others ask again
        hall.settle()
        for robot in ROBOTS:
            said += [(robot, c.query, c.vector.tobytes()) for c in hall.said(robot, m.Cognition)]
        vectors.append({(robot, query): vector for robot, query, vector in said})
    whole, lossy = vectors
    assert {key for key in whole if key[0] != "r1"} <= lossy.keys()
    assert ("r1", 5) in lossy
    assert [key for key, vector in lossy.items() if vector != whole[key]] == []
