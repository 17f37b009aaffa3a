"""A PONDER that is told: what it answers is the stand-in of the newest subgoal, read with the episode's instruction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ponderpounce.training.stand_in import stand_in
from protocol import messages as m
from protocol.link import Link
from protocol.topics import COGNITION, SUBGOAL
from sim_client.told_cognition import ToldPonder

K, H = 2, 64
SWING = "move to the top of the left-side target at <100, 60> for the second time"
TWO_SWINGS = "left-side target, repeating this back-and-forth motion two times, finally press the button to stop"
NO_SWINGS = "press the button"
Told = Callable[..., list[m.Cognition]]


@pytest.fixture
def told(
    new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule, fake_pounce: Any
) -> Told:
    """Plays an episode in which the simulator says each text after so many answers; returns all answers."""
    fake_pounce.spec = replace(fake_pounce.spec, num_carriers=K, cognition_size=H)

    class WithTold(new_rig):  # type: ignore[misc, valid-type]
        def start_ponder(self, link: Link, engine: Any) -> Any:
            return ToldPonder(link, K, H, onward=onward.pop() if onward else None)

    onward: list[Callable[[], str]] = []

    def play(
        subgoals: list[tuple[int, str]], instruction: str = NO_SWINGS, after: Callable[[], str] | None = None
    ) -> list[m.Cognition]:
        onward[:] = [] if after is None else [after]
        rig = WithTold(pounce_engine=fake_pounce)
        take, left = rig.listen(COGNITION), list(subgoals)

        def speak() -> None:
            take()
            while left and left[0][0] <= len(rig.said[m.Cognition]):
                _, text = left.pop(0)
                for kind in (m.SubgoalKind.TASK_SIMPLE, m.SubgoalKind.TASK_GROUNDED):
                    rig.links["sim"].publish(SUBGOAL, m.Subgoal(kind=kind, text=text), at_ns=0, clock_id="sim")

        rig.meanwhile = speak
        rig.run(episode_info(paper, instruction=instruction), 65)
        take()
        return list(rig.said[m.Cognition])

    return play


def test_the_newest_subgoal_is_answered_and_is_new_once(told: Told) -> None:
    first, second = "press the button at <10, 20>", "pick up the container at <30, 40>"
    said = told([(0, first), (2, second)])
    assert len(said) == 4
    for each, text in zip(said, (first, first, second, second), strict=True):
        np.testing.assert_array_equal(each.vector, np.tile(stand_in(text, H), (K, 1)))
    assert [each.is_transition for each in said] == [True, False, True, False]


def test_the_last_swing_is_told_by_the_episode_s_instruction(told: Told) -> None:
    vectors = {}
    for instruction in (TWO_SWINGS, NO_SWINGS):
        said = told([(0, SWING)], instruction)
        vectors[instruction] = said[-1].vector
        np.testing.assert_array_equal(said[-1].vector, np.tile(stand_in(SWING, H, instruction), (K, 1)))
    assert not np.array_equal(vectors[TWO_SWINGS], vectors[NO_SWINGS])


def test_where_it_goes_on_is_told_besides_if_somebody_knows(told: Told) -> None:
    text = "pick up the container at <30, 40>"
    for place in ("<80, 90>", ""):
        for each in told([(0, text)], after=lambda place=place: place):
            np.testing.assert_array_equal(each.vector, np.tile(stand_in(text, H, onward=place), (K, 1)))
