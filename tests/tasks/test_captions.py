"""Texts: two readings of one template, and coordinates that are fixed once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.tasks.captions import ALL_DONE, Caption, completed, follow, grounded, letter, num_coordinates, simple

HOOK = "Hook the cube[ at <>] to the target[ at <>] with the peg"
pixels = st.tuples(st.integers(0, 255), st.integers(0, 255))


@given(st.lists(pixels, min_size=2, max_size=2))
def test_a_filled_text_has_no_empty_place(points: list[tuple[int, int]]) -> None:
    text = grounded(HOOK, points)
    assert "<>" not in text
    assert "[" not in text


@pytest.mark.parametrize("template", ["press the button[ at <>]", HOOK, "place the cube onto the table"])
def test_the_simple_text_is_the_grounded_one_without_coordinates(template: str) -> None:
    points = [(1, 2)] * num_coordinates(template)
    assert simple(template) == grounded(template, points).replace(" at <1, 2>", "")


def test_coordinates_are_filled_in_order_row_first() -> None:
    assert grounded(HOOK, [(1, 2), (3, 4)]) == "Hook the cube at <1, 2> to the target at <3, 4> with the peg"


@pytest.mark.parametrize("points", [[], [(1, 2)], [(1, 2)] * 3])
def test_a_wrong_number_of_points_is_refused(points: list[tuple[int, int]]) -> None:
    with pytest.raises(ValueError, match="takes 2 coordinates"):
        grounded(HOOK, points)


def test_coordinates_stay_until_the_subtask_changes() -> None:
    first = follow(None, 0, "press the button[ at <>]", lambda: [(1, 2)])
    later = follow(first, 0, "press the button[ at <>]", lambda: [(9, 9)])
    changed = follow(later, 1, "press the button[ at <>]", lambda: [(9, 9)])
    assert later.grounded == "press the button at <1, 2>"
    assert changed.grounded == "press the button at <9, 9>"


def test_a_hidden_object_is_spoken_of_plainly_until_it_is_seen() -> None:
    hidden = follow(None, 0, "press the button[ at <>]", lambda: None)
    seen = follow(hidden, 0, "press the button[ at <>]", lambda: [(1, 2)])
    assert hidden.grounded == hidden.simple == "press the button"
    assert seen.grounded == "press the button at <1, 2>"


def test_a_fixed_text_looks_no_more() -> None:
    def look() -> None:
        raise AssertionError("looked again")

    latched = Caption(index=0, simple="a", grounded="a at <1, 2>", is_latched=True)
    assert follow(latched, 0, "a[ at <>]", look) is latched


def test_at_the_end_the_grounded_text_keeps_the_last_instruction() -> None:
    end = completed(Caption(index=3, simple="pick", grounded="pick at <1, 2>", is_latched=True))
    assert (end.simple, end.grounded) == (ALL_DONE, "pick at <1, 2>")


def test_letters_go_from_the_left_of_the_picture_to_the_right() -> None:
    assert [letter(index, [0.1, -0.2, 0.0]) for index in range(3)] == ["C", "A", "B"]
