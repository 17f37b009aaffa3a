"""A chat planner on the bus: its subgoals reach POUNCE's prompt, its failures the log, and nobody waits for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from ponder_server.chat.ask import Ask
from ponder_server.chat.client import ChatEndpoint
from ponder_server.chat.engine import ChatPonder
from ponder_server.contract import EngineSpec
from ponder_server.node import PonderNode
from protocol import messages as m
from protocol import topics
from protocol.link import Link
from protocol.process import host_clock_id

ASK = Ask(prompt="An arm of three joints.")
Info = Callable[..., m.EpisodeInfo]


def planner(chat: Any) -> ChatPonder:
    return ChatPonder(ChatEndpoint(chat.url), "tiny-vl", ASK, answer_s=0.3, start_s=5.0)


@pytest.fixture
def planned(new_rig: Callable[..., Any], fake_pounce: Any, chat: Any) -> Callable[..., Any]:
    """A rig with a chat planner and a POUNCE that reads its text."""

    def build(**spec: Any) -> Any:
        text = {"num_carriers": 0, "reads_subgoal": True}
        fake_pounce.spec = dataclasses.replace(fake_pounce.spec, **(text | spec))
        return new_rig(ponder_engine=planner(chat), pounce_engine=fake_pounce)

    return build


def test_subgoals_reach_the_prompt_and_failures_the_log(
    planned: Any, chat: Any, turns: Any, episode_info: Info, paper: m.Schedule
) -> None:
    rig = planned()
    take = rig.listen(topics.EVENT, topics.SUBGOAL, topics.COGNITION)
    chat.script = [turns["sends"](b"no memory", 500), turns["says"]("pick"), chat.hangs, turns["says"]("place")]
    rig.run(episode_info(paper), 90)
    take()
    assert [request.subgoal for request in rig.pounce_engine.requests] == ["", "pick", "pick", "place", "place"]
    written = [subgoal.text for subgoal in rig.said[m.Subgoal] if subgoal.kind == m.SubgoalKind.SUBGOAL]
    assert written == ["pick", "place"]
    assert [cognition.is_transition for cognition in rig.said[m.Cognition]][:4] == [False, True, False, True]
    told = [(event.name, event.text) for event in rig.said[m.Event]]
    assert ("no_reply", f"query 0: HTTP 500 from {chat.url}: no memory") in told
    assert ("no_reply", "query 2: no reply within 0.3 s") in told
    introduced = [text for name, text in told if name == "ponder_is"]
    assert introduced == [f"zero-shot planner tiny-vl at {chat.url}, asked as in {ASK.digest} for any subgoal"]


def test_a_planner_moves_a_real_robot(
    planned: Any, episode_info: Info, robot_with: Callable[..., m.Robot], paper: m.Schedule
) -> None:
    rig = planned()
    service = rig.links["sim"].serve(topics.TIME)
    reply = m.TimeReply(clock_id=host_clock_id())

    def tell(request: m.TimeRequest) -> m.TimeReply:
        return dataclasses.replace(reply, t1_ns=request.t0_ns, t2_ns=request.t0_ns)

    rig.bus.add_participant(lambda: service.answer(tell) > 0)
    assert rig.open(episode_info(paper, robot=robot_with(is_simulated=False))).error == ""


def test_a_pounce_that_reads_cognition_is_refused(planned: Any, episode_info: Info, paper: m.Schedule) -> None:
    reply = planned(num_carriers=2, reads_subgoal=False).open(episode_info(paper))
    assert reply.error.startswith("POUNCE reads vectors (prefix), PONDER gives text. ")


def test_a_restarted_planner_asks_about_nothing_that_is_past(
    planned: Any, chat: Any, episode_info: Info, paper: m.Schedule
) -> None:
    rig, successor = planned(), planner(chat)
    num_asked = len(chat.requests)
    restarted: list[int] = []

    def restart() -> None:
        if not restarted and rig.clock.conductor.num_queries == 3:
            restarted.append(len(chat.requests))
            successor.warm_up = lambda: [1]
            rig.ponder = rig.start_ponder(Link(rig.bus, robot="r0", proc="ponder"), successor)

    rig.meanwhile = restart
    take = rig.listen(topics.COGNITION)
    rig.run(episode_info(paper), 130)
    take()
    assert restarted
    queries = {cognition.query for cognition in rig.said[m.Cognition]}
    assert queries == set(range(len(queries)))
    assert len(chat.requests) - num_asked == len(queries)


@pytest.mark.parametrize(("is_live", "answered"), [(True, [4]), (False, [0, 1, 2, 3, 4])])
def test_only_in_real_time_is_a_query_left_out_for_a_newer_one(
    planned: Any, rig: Any, is_live: bool, answered: list[int]
) -> None:
    spec: EngineSpec = planned().ponder_engine.spec
    node = PonderNode(spec)
    node.open(is_live=is_live)
    for query in range(5):
        node.on_observation(rig.observation(query, query))
        node.on_query(m.Query(query=query, tick=query, source_ns=query))
    taken = []
    while (work := node.next_work()) is not None:
        taken.append(work.query.query)
    assert taken == answered
