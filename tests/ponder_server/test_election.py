"""What several readings agree on: laws of the election."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st
from ponder_server.election import Said, elected, elected_place

NEAR = 30
PLACES = st.tuples(st.integers(0, 1000), st.integers(0, 1000))
WORDS = st.sampled_from(["pick up the cube", "press the button", "put it down"])


@st.composite
def texts(draw: st.DrawFn) -> str:
    places = draw(st.lists(PLACES, max_size=3))
    return ", ".join([draw(WORDS), *(f"[{x}, {y}]" for x, y in places)])


SPOKEN: st.SearchStrategy[Said] = st.lists(texts(), min_size=1, max_size=2).map(tuple)
ANSWERS: st.SearchStrategy[Said] = st.just(()) | SPOKEN


def words_of(answer: Said) -> list[str]:
    return [re.sub(r"\d+", "#", text) for text in answer]


@given(ANSWERS, st.integers(1, 7))
def test_of_one_mind(answer: Said, count: int) -> None:
    assert elected([answer] * count, NEAR) == answer


@given(st.lists(ANSWERS, min_size=1, max_size=7))
def test_nothing_is_said_in_words_that_nobody_said(said: list[Said]) -> None:
    assert words_of(elected(said, NEAR)) in [[], *map(words_of, said)]


@given(st.lists(ANSWERS, min_size=1, max_size=7))
def test_most_decide_whether_to_speak(said: list[Said]) -> None:
    speaking = sum(bool(each) for each in said)
    if 2 * speaking != len(said):
        assert bool(elected(said, NEAR)) == (2 * speaking > len(said))
    else:
        assert bool(elected(said, NEAR)) == bool(said[0])


@given(SPOKEN, st.lists(ANSWERS, max_size=3), st.randoms(use_true_random=False))
def test_what_most_say_alike_is_said(answer: Said, others: list[Said], random: object) -> None:
    said = [*others, *[answer] * (len(others) + 1)]
    random.shuffle(said)  # type: ignore[attr-defined]
    assert words_of(elected(said, NEAR)) == words_of(answer)


@given(st.lists(PLACES, min_size=1, max_size=5), PLACES)
def test_a_place_is_told_in_the_middle_of_those_near_it(
    offsets: list[tuple[int, int]], middle: tuple[int, int]
) -> None:
    near = [(middle[0] + x % 7, middle[1] + y % 7) for x, y in offsets]
    (text,) = elected([(f"go to [{x}, {y}]",) for x, y in near], NEAR)
    x, y = map(int, re.findall(r"\d+", text))
    assert abs(x - sum(a for a, _ in near) / len(near)) <= 0.5
    assert abs(y - sum(b for _, b in near) / len(near)) <= 0.5


def test_an_outlier_is_neither_heard_nor_averaged() -> None:
    said = [
        ("pick it up at [700, 700], [10, 10]",),
        ("pick it up at [100, 200], [10, 10]",),
        ("pick it up at [104, 200], [14, 10]",),
    ]
    assert elected(said, NEAR) == ("pick it up at [102, 200], [11, 10]",)


def test_waits_are_held_against_each_other_as_places_are() -> None:
    assert elected([("press in 90 steps",), ("press in 41 steps",), ("press in 45 steps",)], NEAR) == (
        "press in 41 steps",
    )


def test_of_two_who_disagree_the_first_is_heard() -> None:
    assert elected([("go to [1, 1]",), ("go to [900, 900]",)], NEAR) == ("go to [1, 1]",)
    assert elected([(), ("go to [1, 1]",)], NEAR) == ()
    assert elected([("go to [1, 1]",), ()], NEAR) == ("go to [1, 1]",)


def test_a_second_look_counts_where_more_than_half_of_all_have_found_the_same_place() -> None:
    here, there = ("pick it up at [100, 200]",), ("pick it up at [400, 200]",)
    assert elected_place([here, here, there], NEAR, 3) == here
    assert elected_place([here, here], NEAR, 4) == ()
    assert elected_place([here, there, there], NEAR, 5) == ()
    assert elected_place([], NEAR, 3) == ()
