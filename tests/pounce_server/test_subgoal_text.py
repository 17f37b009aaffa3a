"""A POUNCE that reads text gets the subgoal of the moment: PONDER's of the query referred to, or the task's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pounce_server.serve import PounceServer
from pounce_server.subgoal_text import Source, SubgoalText
from protocol import messages as m
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.topics import SUBGOAL


def invocation(tick: int, ref_query: int | None) -> m.Invocation:
    return m.Invocation(
        invocation=0, tick=tick, now_ns=0, ref_query=ref_query, age_ns=0, cognition=np.zeros((0, 0), np.float32), seed=0
    )


def subgoal(kind: m.SubgoalKind, text: str, *, tick: int = 0, query: int | None = None) -> m.Subgoal:
    return m.Subgoal(kind=kind, text=text, tick=tick, query=query)


@given(st.sets(st.integers(0, 20), min_size=1), st.none() | st.integers(0, 25))
def test_the_text_is_the_newest_that_the_invocation_may_know(written_at: set[int], ref_query: int | None) -> None:
    texts = SubgoalText("ponder")
    for query in sorted(written_at):
        texts.on_subgoal(subgoal(m.SubgoalKind.SUBGOAL, f"text {query}", query=query))
        texts.on_subgoal(subgoal(m.SubgoalKind.TASK_GROUNDED, "the oracle's", tick=query))
    known = [query for query in written_at if ref_query is not None and query <= ref_query]
    assert texts.at(invocation(0, ref_query)) == (f"text {max(known)}" if known else "")


def test_the_oracle_s_text_is_the_task_s_at_this_tick_as_ponder_would_write_it() -> None:
    texts = SubgoalText("oracle")
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
def text_rig(new_rig: Callable[..., Any], fake_pounce: Any) -> Callable[[Source], Any]:
    """A rig whose POUNCE reads text."""
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=0, reads_subgoal=True)

    def build(source: Source) -> Any:
        class Rig(new_rig):  # type: ignore[misc, valid-type]
            def start_pounce(self, link: Link, engine: Any) -> PounceServer:
                server = PounceServer(link, engine, Heartbeat(link, "test", "host/monotonic"), "test", source)
                server.warm_up()
                server.ready()
                return server

        return Rig(pounce_engine=fake_pounce)

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


def test_a_pounce_that_reads_cognition_gets_no_text(
    text_rig: Callable[[Source], Any], fake_pounce: Any, episode_info: Any, paper: m.Schedule
) -> None:
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=2, reads_subgoal=False)
    reply = text_rig("oracle").open(episode_info(paper))
    assert "reads cognition and no subgoals" in reply.error
