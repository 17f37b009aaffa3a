"""A request and the observation it names meet, whichever comes first."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_server.rendezvous import KEEP_OBSERVATIONS, Rendezvous
from protocol.messages import Observation, Query


def look(tick: int) -> Observation:
    return Observation(tick=tick, source_ns=tick, proprio=np.zeros(1, np.float32))


def ask(query: int, tick: int) -> Query:
    return Query(query=query, tick=tick, source_ns=tick)


def pairs(meeting: Rendezvous[Query]) -> list[tuple[int, int]]:
    found = []
    while (pair := meeting.next_pair()) is not None:
        found.append((pair[0].query, pair[1].tick))
    return found


@pytest.fixture
def meeting() -> Rendezvous[Query]:
    return Rendezvous(keep_requests=8)


@given(arrivals=st.permutations([("look", t) for t in range(6)] + [("ask", t) for t in range(6)]))
def test_in_any_order_of_arrival_every_request_meets_its_observation(arrivals: list[tuple[str, int]]) -> None:
    meeting: Rendezvous[Query] = Rendezvous(keep_requests=8)
    met = []
    for kind, tick in arrivals:
        if kind == "look":
            meeting.on_observation(look(tick))
        else:
            meeting.on_request(ask(tick, tick))
        met += pairs(meeting)
    assert sorted(met) == [(tick, tick) for tick in range(6)]


def test_requests_are_met_oldest_first(meeting: Rendezvous[Query]) -> None:
    for t in range(4):
        meeting.on_request(ask(t, t))
    for t in reversed(range(4)):
        meeting.on_observation(look(t))
    assert pairs(meeting) == [(t, t) for t in range(4)]


def test_a_request_waits_for_its_observation(meeting: Rendezvous[Query]) -> None:
    meeting.on_request(ask(0, 5))
    meeting.on_observation(look(4))
    assert pairs(meeting) == []
    meeting.on_observation(look(5))
    assert pairs(meeting) == [(0, 5)]


def test_an_observation_may_serve_two_requests(meeting: Rendezvous[Query]) -> None:
    meeting.on_observation(look(5))
    meeting.on_request(ask(0, 5))
    meeting.on_request(ask(1, 5))
    assert pairs(meeting) == [(0, 5), (1, 5)]


def test_only_the_newest_observations_are_kept(meeting: Rendezvous[Query]) -> None:
    for tick in range(KEEP_OBSERVATIONS + 1):
        meeting.on_observation(look(tick))
    meeting.on_request(ask(0, 0))
    meeting.on_request(ask(1, 1))
    assert pairs(meeting) == [(1, 1)]


@given(keep=st.integers(1, 5), count=st.integers(0, 12))
def test_too_many_requests_supersede_the_oldest_and_are_counted(keep: int, count: int) -> None:
    meeting: Rendezvous[Query] = Rendezvous(keep_requests=keep)
    meeting.on_observation(look(0))
    for query in range(count):
        meeting.on_request(ask(query, 0))
    assert meeting.num_superseded == max(0, count - keep)
    assert [query for query, _ in pairs(meeting)] == list(range(count))[-keep:]


def test_a_request_is_given_up_once_the_ring_has_moved_past(meeting: Rendezvous[Query]) -> None:
    meeting.on_request(ask(0, 3))
    meeting.on_observation(look(4))
    assert [request.query for request in meeting.give_up()] == [0]
    assert list(meeting.give_up()) == []


def test_a_request_whose_observation_may_come_is_not_given_up(meeting: Rendezvous[Query]) -> None:
    meeting.on_request(ask(0, 3))
    assert list(meeting.give_up()) == []
    meeting.on_observation(look(2))
    assert list(meeting.give_up()) == []


def test_a_request_whose_observation_is_the_oldest_here_is_not_given_up(meeting: Rendezvous[Query]) -> None:
    for tick in (3, 4):
        meeting.on_observation(look(tick))
    meeting.on_request(ask(0, 3))
    assert list(meeting.give_up()) == []


def test_a_cleared_rendezvous_knows_nothing(meeting: Rendezvous[Query]) -> None:
    meeting.on_request(ask(0, 3))
    meeting.on_observation(look(3))
    meeting.clear()
    meeting.on_observation(look(3))
    assert pairs(meeting) == []
