"""Deeds of a demonstration: told apart by words and place, counted, and each with the one before."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.training.augment import View
from dual_system.training.deeds import deeds, narration, passing_side

DONE = st.lists(st.tuples(st.sampled_from(["pick at", "put onto a target at", "move left to"]), st.integers(0, 3)))


@given(done=DONE, lengths=st.lists(st.integers(1, 3), min_size=30, max_size=30))
def test_every_deed_counts_once_however_long_it_is_seen(done: list[tuple[str, int]], lengths: list[int]) -> None:
    done = [deed for deed, last in zip(done, [None, *done], strict=False) if deed != last][: len(lengths)]
    texts = [f"{words} <{20 * place}, 9>" for (words, place), n in zip(done, lengths, strict=False) for _ in range(n)]
    found = deeds(texts)
    spans = [number for number, n in zip(range(len(done)), lengths, strict=False) for _ in range(n)]
    for deed, at in zip(found, spans, strict=True):
        words, place = done[at]
        assert deed.number == at + 1
        assert deed.count == sum(other == words for other, _ in done[: at + 1])
        assert deed.place == (20 * place, 9)
        assert deed.place_before == (None if at == 0 else (20 * done[at - 1][1], 9))


def test_a_text_that_gets_its_place_later_is_the_same_deed() -> None:
    found = deeds(["pick", "pick at <9, 9>", "pick at <10, 9>", "static"])
    assert [deed.number for deed in found] == [1, 1, 1, 2]
    assert [deed.name for deed in found] == ["pick", "pick", "pick", "static"]
    assert [deed.place for deed in found] == [None, (9, 9), (10, 9), None]


def test_how_a_way_goes_on_is_no_part_of_a_deed() -> None:
    (deed,) = deeds(["move left to <9, 9>, then <8, 8>"])
    assert (deed.name, deed.place) == ("move left", (9, 9))


def test_what_is_only_watched_is_one_deed_wherever_it_moves() -> None:
    found = deeds(
        [
            "pick up the cube at <9, 9>",
            "static at <30, 9>, <80, 80>",
            "static at <60, 9>, <81, 80>",
            "static at <90, 9>",
        ]
    )
    assert [deed.number for deed in found] == [1, 2, 2, 2]
    assert [deed.place for deed in found] == [(9, 9), (30, 9), (60, 9), (90, 9)]
    assert [deed.place_before for deed in found] == [None, (80, 80), (81, 80), None]


PUTS = st.lists(st.one_of(st.just("button"), st.tuples(st.integers(0, 9), st.integers(0, 9))), min_size=1, max_size=5)


@given(PUTS, st.integers(1, 3))
def test_a_narration_tells_every_place_in_order_and_when_the_button_was_pressed(
    done: list[str | tuple[int, int]], seen: int
) -> None:
    texts: list[str] = []
    for nth, each in enumerate(done):
        what = "press the button" if isinstance(each, str) else "drop the cube onto target"
        place = (7 + nth, 7) if isinstance(each, str) else (20 * each[0], 20 * each[1])
        pick = [f"pick up the cube at <{nth}, 200>"] * seen
        texts += [*pick, *[f"{what} at <{place[0]}, {place[1]}>"] * seen]
    texts.append("static at <1, 1>, <2, 2>")
    puts = [each for each in done if not isinstance(each, str)]
    told = narration(texts).split(", ") if puts else []
    numbers = iter(["first", "second", "third", "fourth", "fifth"])
    expected = [each if isinstance(each, str) else f"{next(numbers)} <{20 * each[0]}, {20 * each[1]}>" for each in done]
    assert told == (", ".join(expected).split(", ") if puts else [])
    assert puts or narration(texts) == ", ".join(f"<{nth}, 200>" for nth in range(len(done)))


def around(towards: str, turn: str, y: int, x: int, then: str = "") -> str:
    return f"move to the nearest {towards} target by circling around the stick {turn} to <{y}, {x}>{then}"


def test_of_a_way_around_things_the_side_is_told() -> None:
    """As the front camera sees it: its left is the picture's right, and clockwise is seen from above."""
    texts = [
        *[around("left", "clockwise", 89, 167, ", then clockwise to <96, 203>")] * 3,
        *[around("left", "clockwise", 96, 203, ", then clockwise to <89, 167>")] * 2,
        *[around("right", "clockwise", 89, 167)] * 3,
    ]
    assert narration(texts) == "1 left backward <89, 167>, 2 left backward <96, 203>, 3 right forward <89, 167>"
    assert narration(texts[2:4]) == "1 left backward <89, 167>, 2 left backward <96, 203>"


@pytest.mark.parametrize("towards", ["left", "right"])
@pytest.mark.parametrize("turn", ["clockwise", "counterclockwise"])
def test_nearer_to_the_robot_is_so_in_a_mirror_too(towards: str, turn: str) -> None:
    text = around(towards, turn, 89, 167)
    mirrored = View(is_mirrored=True).text(text)
    assert mirrored != text
    assert passing_side(mirrored) == passing_side(text) != ""
    assert passing_side("move left to <9, 9>") == passing_side("press the button") == ""


def test_a_picked_block_is_told_and_a_way_is_not() -> None:
    assert narration(["pick up the cube at <9, 8>", "drop the cube on the table at <9, 8>, <1, 2>"]) == "<9, 8>"
    assert narration(["move left to <9, 9>, then <8, 8>", "move right to <8, 8>"]) == ""
    assert narration([]) == ""
