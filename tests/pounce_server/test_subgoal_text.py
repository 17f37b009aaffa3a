"""A POUNCE that reads text gets the subgoal of the moment: PONDER's, inside the invocation, or the task's own."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ponder_server.contract import Text
from pounce_server.serve import PounceServer
from pounce_server.subgoal_text import OracleText, Source
from protocol import messages as m
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.topics import COGNITION, INVOCATION, SUBGOAL


def invocation(tick: int, ref_query: int | None) -> m.Invocation:
    return m.Invocation(
        invocation=0, tick=tick, now_ns=0, ref_query=ref_query, age_ns=0, cognition=np.zeros((0, 0), np.float32), seed=0
    )


def subgoal(kind: m.SubgoalKind, text: str, *, tick: int = 0, query: int | None = None) -> m.Subgoal:
    return m.Subgoal(kind=kind, text=text, tick=tick, query=query)


def test_the_oracle_s_text_is_the_task_s_at_this_tick_as_ponder_would_write_it() -> None:
    texts = OracleText()
    texts.on_subgoal(subgoal(m.SubgoalKind.TASK_GROUNDED, "press at <128, 64>"))
    texts.on_subgoal(subgoal(m.SubgoalKind.TASK_SIMPLE, "pick", tick=30))
    texts.on_subgoal(subgoal(m.SubgoalKind.TASK_GROUNDED, "pick at <10, 20>", tick=30))
    texts.on_subgoal(subgoal(m.SubgoalKind.SUBGOAL, "PONDER's", query=0))
    assert [texts.at(invocation(tick, 0)) for tick in (0, 29, 30)] == [
        "press at [250, 500]", "press at [250, 500]", "pick at [78, 39]",
    ]  # fmt: skip
    texts.clear()
    assert texts.at(invocation(99, 9)) == ""


@pytest.fixture
def text_rig(new_rig: Callable[..., Any], fake_pounce: Any) -> Callable[..., Any]:
    """A rig whose POUNCE reads text."""
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=0, reads_subgoal=True)

    def build(source: Source | None, **engines: Any) -> Any:
        class Rig(new_rig):  # type: ignore[misc, valid-type]
            def start_pounce(self, link: Link, engine: Any) -> PounceServer:
                server = PounceServer(link, engine, Heartbeat(link, "test", "host/monotonic"), "test", source)
                server.warm_up()
                server.ready()
                return server

        return Rig(pounce_engine=fake_pounce, **engines)

    return build


def test_the_texts_of_an_episode_reach_the_engine(
    text_rig: Callable[[Source], Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    rig = text_rig("oracle")
    info = episode_info(paper)
    spoken: list[int] = []

    def speak() -> None:
        """The robot says another subgoal at tick 30."""
        conductor = rig.clock.conductor
        if conductor is not None and conductor.tick >= 30 and not spoken:
            spoken.append(30)
            rig.links["sim"].publish(SUBGOAL, subgoal(m.SubgoalKind.TASK_GROUNDED, "place", tick=30), at_ns=0)

    rig.meanwhile = speak
    rig.run(info, 70)
    assert [request.subgoal for request in rig.pounce_engine.requests] == ["", "", "place", "place"]


@pytest.mark.parametrize("source", [None, "ponder"])
def test_ponder_s_newest_ready_subgoal_comes_with_the_invocation(
    source: Source | None, text_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    rig = text_rig(source)
    num_fires = itertools.count()

    def speak() -> None:
        """The first and the third fire write a subgoal; it holds until the next."""
        said = {0: "pick", 2: "place"}.get(next(num_fires))
        rig.ponder_engine.texts = (Text(kind="subgoal", text=said, token_ids=(), truncated=False),) if said else ()

    rig.ponder_engine.on_fire = speak
    take = rig.listen(COGNITION, INVOCATION)
    rig.run(episode_info(paper), 90)
    take()
    assert [request.subgoal for request in rig.pounce_engine.requests] == ["pick", "pick", "place", "place", "place"]
    written_ns = {c.query: c.text_source_ns for c in rig.said[m.Cognition]}
    source_ns = {c.query: c.source_ns for c in rig.said[m.Cognition]}
    assert [written_ns[query] for query in range(4)] == [source_ns[query] for query in (0, 0, 2, 2)]
    for invocation in rig.said[m.Invocation]:
        assert invocation.text_age_ns == invocation.now_ns - written_ns[invocation.ref_query]

    null = dataclasses.replace(paper, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    rig.run(episode_info(null, epoch=2), 30)
    assert rig.pounce_engine.requests[-1].subgoal == ""  # the task alone


def test_a_ponder_that_writes_nothing_is_refused(
    text_rig: Any, fake_ponder: Any, episode_info: Any, paper: m.Schedule
) -> None:
    fake_ponder.spec = dataclasses.replace(fake_ponder.spec, gives_text=False)
    reply = text_rig(None, ponder_engine=fake_ponder).open(episode_info(paper))
    assert "POUNCE reads text (prompt), PONDER gives vectors" in reply.error
    assert reply.refusal == m.Refusal.MODELS


def test_a_pounce_that_reads_cognition_gets_no_text(
    text_rig: Callable[[Source], Any], fake_pounce: Any, episode_info: Any, paper: m.Schedule
) -> None:
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=2, reads_subgoal=False)
    reply = text_rig("oracle").open(episode_info(paper))
    assert "reads cognition and no subgoals" in reply.error
