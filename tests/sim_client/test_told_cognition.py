"""A PONDER that is told: what it answers is the stand-in of the newest subgoal, read with the episode's instruction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dual_system.training.stand_in import stand_in

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
            return ToldPonder(link, K, H, 0.0, onward.pop() if onward else None, lambda: due[0], waits_longer=longer[0])

    onward: list[Callable[[], str]] = []
    due: list[int | None] = [None]
    longer = [0]

    def play(
        subgoals: list[tuple[int, str]],
        instruction: str = NO_SWINGS,
        after: Callable[[], str] | None = None,
        due_step: int | None = None,
        waits_longer: int = 0,
        tick: int = 0,
    ) -> list[m.Cognition]:
        onward[:], due[:], longer[:] = [] if after is None else [after], [due_step], [waits_longer]
        rig = WithTold(pounce_engine=fake_pounce)
        take, left = rig.listen(COGNITION), list(subgoals)

        def speak() -> None:
            take()
            while left and left[0][0] <= len(rig.said[m.Cognition]):
                _, text = left.pop(0)
                for kind in (m.SubgoalKind.TASK_SIMPLE, m.SubgoalKind.TASK_GROUNDED):
                    subgoal = m.Subgoal(kind=kind, text=text, tick=tick)
                    rig.links["sim"].publish(SUBGOAL, subgoal, at_ns=0, clock_id="sim")

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


def test_how_long_there_is_to_wait_is_told_and_where_it_stands_and_then_no_more(told: Told) -> None:
    hover, still, press = "move to the top of the button at <10, 20> to prepare", "remain static", "press at <30, 40>"
    subgoals = [(0, hover), (1, still), (3, press)]
    said = told(subgoals, due_step=40)
    first, second, third, last = said
    assert [each.tick for each in said] == [0, 14, 34, 54]
    np.testing.assert_array_equal(first.vector[0], stand_in(hover, H, onward="<0, 40>"))
    np.testing.assert_array_equal(second.vector[0], stand_in(f"{still} until <0, 26>", H, onward="<10, 20>"))
    np.testing.assert_array_equal(third.vector[0], stand_in(f"{still} until <0, 6>", H, onward="<10, 20>"))
    np.testing.assert_array_equal(last.vector[0], stand_in(press, H, onward="<10, 20>"))

    later = told(subgoals, due_step=40, waits_longer=15)[-1]
    np.testing.assert_array_equal(later.vector[0], stand_in(f"{still} until <0, 1>", H, onward="<10, 20>"))


def test_what_the_picture_that_is_asked_about_does_not_show_yet_is_told_to_the_next(told: Told) -> None:
    text = "press the button at <10, 20>"
    said = told([(0, text)], tick=20)
    assert [each.tick for each in said] == [0, 14, 34, 54]
    assert [each.is_transition for each in said] == [True, False, True, False], "the rig's own of tick 0, and this one"
    for each, heard in zip(said, ("", "", text, text), strict=True):
        np.testing.assert_array_equal(each.vector[0], stand_in(heard, H))
