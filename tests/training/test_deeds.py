"""Deeds of a demonstration: told apart by words and place, counted, and each with the one before."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ponderpounce.training.deeds import deeds

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
