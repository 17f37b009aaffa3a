"""A PONDER that is told the task's subgoals passes them on with PONDER's delay and age."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dual_system.models.ponder.coordinates import XY_1000, YX_PX, yx_px_from_xy_1000
from protocol import messages as m
from protocol.link import Link
from protocol.topics import COGNITION, INVOCATION, SUBGOAL
from sim_client.telling_ponder import TellingPonder

GROUNDED, SIMPLE = m.SubgoalKind.TASK_GROUNDED, m.SubgoalKind.TASK_SIMPLE
TEXTS = {0: ("press at <128, 64>", "press"), 30: ("pick at <10, 20>", "pick")}
"""By the tick from which they are valid."""


@pytest.fixture
def played(
    new_rig: Callable[..., Any], fake_pounce: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> Callable[[m.SubgoalKind], Any]:
    fake_pounce.spec = dataclasses.replace(fake_pounce.spec, num_carriers=0, reads_subgoal=True)

    def play(kind: m.SubgoalKind, epochs: int = 1, off_px: float = 0.0) -> Any:
        class Told(new_rig):  # type: ignore[misc, valid-type]
            def start_ponder(self, link: Link, engine: Any) -> Any:
                return TellingPonder(link, kind, off_px)

        rig = Told(pounce_engine=fake_pounce)
        take = rig.listen(COGNITION, INVOCATION)
        for epoch in range(1, epochs + 1):
            said: set[int] = set()

            def speak(said: set[int] = said) -> None:
                """The robot says every subgoal when its tick has come."""
                conductor = rig.clock.conductor
                for tick, texts in TEXTS.items():
                    if conductor is not None and conductor.tick >= tick and tick not in said:
                        said.add(tick)
                        for each, text in zip((GROUNDED, SIMPLE), texts, strict=True):
                            rig.links["sim"].publish(SUBGOAL, m.Subgoal(kind=each, text=text, tick=tick), at_ns=0)

            rig.meanwhile = speak
            rig.run(episode_info(paper, epoch=epoch), 90)
        take()
        return rig

    return play


@pytest.mark.parametrize(
    ("kind", "first", "second"), [(GROUNDED, "press at [250, 500]", "pick at [78, 39]"), (SIMPLE, "press", "pick")]
)
def test_a_text_comes_with_the_first_query_after_it_as_ponder_would_write_it(
    played: Any, kind: m.SubgoalKind, first: str, second: str
) -> None:
    rig = played(kind)
    cognitions = rig.said[m.Cognition]
    told = [second if each.tick >= 30 else first for each in cognitions if each.tick]
    assert [each.text for each in cognitions if each.tick] == told
    assert second in told
    assert [each.tick for each in cognitions if each.is_transition][-1] == min(
        each.tick for each in cognitions if each.tick >= 30
    )


def test_pounce_reads_it_as_late_as_any_other_subgoal(played: Any) -> None:
    rig = played(GROUNDED)
    ready_ns = {each.query: each.text_source_ns for each in rig.said[m.Cognition]}
    texts = {each.query: each.text for each in rig.said[m.Cognition]}
    invocations = rig.said[m.Invocation]
    assert {"press at [250, 500]", "pick at [78, 39]"} <= {each.text for each in invocations}
    for each in invocations:
        assert each.age_ns == 300_000_000
        assert each.text == texts[each.ref_query]
        assert not each.text or each.text_age_ns == each.now_ns - ready_ns[each.ref_query]


def test_an_episode_knows_nothing_of_the_one_before(played: Any) -> None:
    rig = played(SIMPLE, epochs=2)
    requests = [request.subgoal for request in rig.pounce_engine.requests]
    assert len(requests) == 10
    assert requests[:5] == requests[5:]


def test_displaced_places_are_as_far_off_as_asked_and_stay_there(played: Any) -> None:
    told = {each.text for each in played(GROUNDED, off_px=12.0).said[m.Cognition]} - {""}
    assert len(told) == 2
    for text in told:
        ((x, y),) = XY_1000.findall(text)
        (meant,) = YX_PX.findall(TEXTS[0 if text.startswith("press") else 30][0])
        off_px = np.hypot(*(int(a) - int(b) for a, b in zip(yx_px_from_xy_1000((int(x), int(y))), meant, strict=True)))
        assert off_px == pytest.approx(12.0, abs=1.0)
