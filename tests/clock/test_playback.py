"""Which row is due at which tick, at any rate; and how chunks are joined."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from clock.playback import (
    Chunk,
    covering,
    deadline_ns,
    ensemble,
    offset_fade,
    row_of,
    seam_policy,
    switch,
    tick_at,
)
from protocol.messages import Floats, Seam, SeamKind

RATES = st.integers(1, 1000)
STARTS = st.integers(-(10**12), 10**12)
TICKS = st.integers(0, 10**7)
H, DIM = 8, 3
LAST = np.array([False, False, True])  # the gripper


def chunk(invocation: int, t_row0: int, rows_NA: Floats | None = None, first_tick: int | None = None) -> Chunk:
    """Rows tell where they come from: (tick, invocation, gripper +-1)."""
    if rows_NA is None:
        gripper = 1.0 if invocation % 2 else -1.0
        rows_NA = np.array([[t_row0 + n, invocation, gripper] for n in range(H)], np.float32)
    return Chunk(invocation=invocation, t_row0=t_row0, rows_NA=rows_NA, ref_query=0, age_ns=0, first_tick=first_tick)


ROWS = hnp.arrays(np.float32, (H, DIM), elements=st.floats(-10, 10, width=32))


@st.composite
def overlapping(draw: st.DrawFn) -> tuple[list[Chunk], int]:
    """Up to four chunks, oldest first, all with a row for one tick."""
    tick = draw(st.integers(H, 50))
    starts = sorted(draw(st.lists(st.integers(tick - H + 1, tick), min_size=1, max_size=4)))
    return [chunk(j, start, draw(ROWS)) for j, start in enumerate(starts)], tick


@given(rate=RATES, start=STARTS, tick=TICKS)
def test_at_its_deadline_a_tick_has_come(rate: int, start: int, tick: int) -> None:
    assert tick_at(start, deadline_ns(start, tick, rate), rate) == tick


@given(rate=RATES, start=STARTS, tick=TICKS)
def test_one_nanosecond_before_its_deadline_it_has_not(rate: int, start: int, tick: int) -> None:
    assert tick_at(start, deadline_ns(start, tick, rate) - 1, rate) == tick - 1


@given(rate=RATES, start=STARTS, tick=TICKS)
def test_a_deadline_is_within_a_nanosecond_of_the_exact_one(rate: int, start: int, tick: int) -> None:
    assert 0 <= (deadline_ns(start, tick, rate) - start) * rate - tick * 10**9 < rate


def test_thirty_hertz_does_not_drift_in_an_hour() -> None:
    assert deadline_ns(0, 30 * 3600, 30) == 3600 * 10**9


@given(rate=RATES, t_row0=TICKS, row=st.integers(0, H - 1))
def test_the_row_due_at_its_deadline_is_that_row(rate: int, t_row0: int, row: int) -> None:
    due_ns = deadline_ns(0, t_row0 + row, rate)
    assert row_of(chunk(0, t_row0), tick_at(0, due_ns, rate)) == row
    assert row_of(chunk(0, t_row0), tick_at(0, due_ns - 1, rate)) == (row - 1 if row else None)


@pytest.mark.parametrize("tick", [4, 5 + H])
def test_a_chunk_has_no_row_outside_itself(tick: int) -> None:
    assert row_of(chunk(0, 5), tick) is None


@given(late=st.integers(0, H - 1))
def test_rows_that_are_past_when_a_chunk_comes_are_never_asked_for(late: int) -> None:
    played = [row_of(chunk(0, 10), tick) for tick in range(10 + late, 10 + H)]
    assert played == list(range(late, H))


@given(chunks_tick=overlapping())
def test_the_newest_covering_chunk_plays(chunks_tick: tuple[list[Chunk], int]) -> None:
    chunks, tick = chunks_tick
    assert covering(chunks[::-1], tick)[-1] is chunks[-1]


def test_an_older_chunk_plays_where_the_newest_does_not_reach() -> None:
    old, new = chunk(0, 0), chunk(1, 5)
    assert covering([old, new], 4) == [old]
    assert not covering([old, new], 5 + H)


# -- seams


@given(chunks_tick=overlapping())
def test_switch_plays_the_newest_row_as_it_is(chunks_tick: tuple[list[Chunk], int]) -> None:
    chunks, tick = chunks_tick
    newest = chunks[-1]
    assert (switch(chunks, tick) == newest.rows_NA[tick - newest.t_row0]).all()


@given(old=ROWS, new=ROWS, at=st.integers(0, H - 1), fade=st.integers(1, 20))
def test_a_fade_is_continuous_at_the_switch(old: Floats, new: Floats, at: int, fade: int) -> None:
    joined = offset_fade(fade, LAST)([chunk(0, 0, old), chunk(1, at, new)], at)
    assert joined[:-1] == pytest.approx(old[at, :-1], abs=1e-5)


@given(old=ROWS, new=ROWS, at=st.integers(0, H - 2), late=st.integers(1, H - 1), fade=st.integers(1, 20))
def test_a_fade_is_continuous_where_a_late_chunk_is_first_played(
    old: Floats, new: Floats, at: int, late: int, fade: int
) -> None:
    first = min(at + late, H - 1)
    joined = offset_fade(fade, LAST)([chunk(0, 0, old), chunk(1, at, new, first_tick=first)], first)
    assert joined[:-1] == pytest.approx(old[first, :-1], abs=1e-5)


@given(old=ROWS, new=ROWS, at=st.integers(1, H - 1), fade=st.integers(1, 6))
def test_a_fade_is_over_after_its_ticks(old: Floats, new: Floats, at: int, fade: int) -> None:
    tick = at + fade
    chunks = [c for c in (chunk(0, 0, old), chunk(1, at, new)) if row_of(c, tick) is not None]
    if chunks and chunks[-1].invocation == 1:
        assert (offset_fade(fade, LAST)(chunks, tick) == new[fade]).all()


@given(old=ROWS, new=ROWS, fade=st.integers(2, 6), since=st.integers(0, 4))
def test_a_fade_shrinks_the_jump_linearly(old: Floats, new: Floats, fade: int, since: int) -> None:
    at = 2
    joined = offset_fade(fade, LAST)([chunk(0, 0, old), chunk(1, at, new)], at + since)
    jump = (old[at] - new[0])[:-1]
    expected = new[since, :-1] + max(0.0, 1 - since / fade) * jump
    assert joined[:-1] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("fade", [0, 5])
def test_a_lone_chunk_has_nothing_to_fade_from(fade: int) -> None:
    lone = chunk(0, 3)
    assert (offset_fade(fade, LAST)([lone], 4) == lone.rows_NA[1]).all()


@given(chunks_tick=overlapping(), decay=st.floats(-2, 2))
def test_an_ensemble_lies_between_its_rows(chunks_tick: tuple[list[Chunk], int], decay: float) -> None:
    chunks, tick = chunks_tick
    rows = np.stack([c.rows_NA[tick - c.t_row0] for c in chunks])
    mean = ensemble(decay, LAST)(chunks, tick)
    assert (mean >= rows.min(axis=0) - 1e-5).all()
    assert (mean <= rows.max(axis=0) + 1e-5).all()


@given(row=hnp.arrays(np.float32, DIM, elements=st.floats(-10, 10, width=32)), decay=st.floats(-2, 2))
def test_an_ensemble_of_agreeing_chunks_is_what_they_say(row: Floats, decay: float) -> None:
    same = np.tile(row, (H, 1))
    chunks = [chunk(j, j, same) for j in range(3)]
    assert ensemble(decay, LAST)(chunks, 4) == pytest.approx(row, abs=1e-5)


def test_a_positive_decay_lets_the_oldest_weigh_most() -> None:
    chunks = [chunk(0, 0), chunk(1, 1)]  # second coordinate: the invocation
    assert ensemble(1.0, LAST)(chunks, 3)[1] == pytest.approx(np.exp(-1) / (1 + np.exp(-1)))


@given(chunks_tick=overlapping())
@pytest.mark.parametrize(
    "seam",
    [
        Seam(kind=SeamKind.SWITCH),
        Seam(kind=SeamKind.OFFSET_FADE, fade_ticks=6),
        Seam(kind=SeamKind.ENSEMBLE, ensemble_decay=0.01),
    ],
    ids=lambda s: s.kind.name,
)
def test_the_gripper_is_a_switch_at_every_seam(seam: Seam, chunks_tick: tuple[list[Chunk], int]) -> None:
    chunks, tick = chunks_tick
    newest = chunks[-1]
    assert seam_policy(seam, LAST)(chunks, tick)[-1] == newest.rows_NA[tick - newest.t_row0, -1]


@given(chunks_tick=overlapping())
@pytest.mark.parametrize("kind", [k for k in SeamKind if k])
def test_joining_changes_no_chunk(kind: SeamKind, chunks_tick: tuple[list[Chunk], int]) -> None:
    chunks, tick = chunks_tick
    before = [c.rows_NA.tobytes() for c in chunks]
    seam_policy(Seam(kind=kind, fade_ticks=4, ensemble_decay=0.1), LAST)(chunks, tick)[:] = 9
    assert [c.rows_NA.tobytes() for c in chunks] == before


def test_asking_for_a_row_that_a_chunk_has_not_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"chunk 0 has rows for ticks 5\.\.; tick 4 is not among them"):
        switch([chunk(0, 5)], 4)
