"""A POUNCE that reads text gets PONDER's newest ready subgoal, inside the invocation."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from ponder_server.contract import Text
from protocol import messages as m
from protocol.topics import COGNITION, INVOCATION


@pytest.fixture
def text_rig(new_rig: Callable[..., Any], fake_pounce: Any) -> Callable[..., Any]:
    """A rig whose POUNCE reads text."""
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=0, reads_subgoal=True)
    return partial(new_rig, pounce_engine=fake_pounce)


def test_ponder_s_newest_ready_subgoal_comes_with_the_invocation(
    text_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    rig = text_rig()
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
    reply = text_rig(ponder_engine=fake_ponder).open(episode_info(paper))
    assert "POUNCE reads text (prompt), PONDER gives vectors" in reply.error
    assert reply.refusal == m.Refusal.MODELS
