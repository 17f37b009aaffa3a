"""Notes: what is followed is written down at every look, so that each one builds on the words of the one before.

A thing that changes places with another is where it was a second ago, and a bit further. In one pass over a video each
second's place would follow from the last one's, one layer above it, and a small network has few layers. What is written
down begins at the first layer again. So PONDER notes, as long as anything moves by itself:

- at every instant of a demonstration, where what will be asked for is then: "<99, 120>";
- at every query, where it is now, behind the subgoal: "press the first button at <60, 90>, <99, 120>";
- if a recipe asks for it (`tells_ends`), of a thing that is changing places also where it will come to rest:
  "<99, 120> to <80, 66>". Half-way through a swap the other one is nearer to where it was last seen, and
  was taken for it. Who knows where it is going is not misled,
  and what is noted last is the place to go to though the swap is not over;
- of a thing that comes by and is to be stopped, also how often it does and how long there is to wait (`countdown`):
  "remain static, <110, 77>, 80, 137". The pace is read off two places, and the wait off pace and place.

The paper has nothing of it; its PONDER is pretrained on video.
"""

# T ticks of an episode, D instants of its demonstration, Q queries

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dual_system.models.eyes import Eyes
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.front_view import front_pixels
from dual_system.tasks.paces import PASS_STEPS, PRESS_STEPS
from dual_system.training.countdown import rhythm, waits
from dual_system.training.deeds import Told, course, told_deeds
from dual_system.training.insertions import ends, manner
from dual_system.training.lapses import Words, has_moved
from dual_system.training.places import ONE_PLACE, PARTS, PLACE, TEXT_PX, WAY, apart_px

if TYPE_CHECKING:
    from dual_system.tasks.task import Task

_WATCHED = "static at "
_STILL = re.compile(
    rf"drop the cube on the table at ({ONE_PLACE})(?:, {ONE_PLACE})?|{_WATCHED}({ONE_PLACE})(?:, ({ONE_PLACE}))?"
)
_TO = " to "
_END = re.compile(rf"{_TO}{ONE_PLACE}")
_UNDERWAY_PX = 3.0
_SAME_PX = 8.0  # less than any two targets lie apart
_WAIT = re.compile(r", \d+, (\d+)$")
_LOOK_STEPS = 25  # a query a second: one at least sees where everything has come to rest
_PACE_STEPS = 30  # two looks; before, nobody can tell how fast it runs


def can_follow() -> bool:
    """Whether scenes can be drawn here: tasks need MuJoCo, which a machine that only trains may not have."""
    return find_spec("mujoco") is not None


def moving_places(task: str, seed: int, difficulty: str, num_steps: int) -> list[str]:
    """Per observation of an episode from reset on, its demonstration's first, where things are that move by themselves.

    ``<y, x>, <y, x>`` as texts tell places, nothing of those outside of the picture, up to a look after the last has
    come to rest; ``<y, x> to <v, u>`` for one that is on its way to a place. Empty where nothing moves. Needs no
    physics: what the seed draws tells it (`Task.moving`, `Task.underway`). Empty, too, where nothing can be drawn
    (`can_follow`).
    """
    drawn = _drawn(task, seed, difficulty)
    if drawn is None:
        return [""] * num_steps
    found_task, layout = drawn
    found: list[str] = []
    for step in range(num_steps):
        points_m = found_task.moving(layout, step)
        if not points_m:
            found += found[-1:] * _LOOK_STEPS
            return [*found, *[""] * num_steps][:num_steps]
        ends_m = (found_task.moving(layout, at) for at in found_task.underway(layout, step))
        places = zip(*map(_in_picture, (points_m, *ends_m)), strict=True)
        found.append(", ".join(_onward(now, whence, rest) for now, whence, rest in places if now))
    return found


def laid_out_places(task: str, seed: int, difficulty: str) -> str:
    """Where things lie that are noted at the first look at a demonstration (`Task.laid_out`), ``<y, x>, <v, u>``.

    From the picture's top on: mirrored, it has the same order. Empty where there are none, or nothing can be drawn.
    """
    drawn = _drawn(task, seed, difficulty)
    if drawn is None:
        return ""
    found_task, layout = drawn
    # the simulator's texts, which tell them too, cut off fractions
    places = [_told(front_pixels(np.array(each), TEXT_PX)) for each in found_task.laid_out(layout)]
    return ", ".join(place for each in sorted(filter(all, places), key=_row) for place in each)


def _row(places: Sequence[str]) -> int:
    found = PLACE.search(places[0])
    return 0 if found is None else int(found[1])


def _drawn(task: str, seed: int, difficulty: str) -> tuple[Task[Any, Any], Any] | None:
    """The task and its layout; None where nothing can be drawn (`can_follow`), or it is none of ours."""
    if not can_follow():
        return None
    from dual_system.tasks.task import make_task, task_names  # here alone: it imports MuJoCo

    if task not in task_names() or difficulty not in DIFFICULTIES:  # somebody else's data, or pictures of many scenes
        return None
    found_task = make_task(task)
    return found_task, found_task.sample(np.random.default_rng(seed), difficulty)


def _in_picture(points_m: Sequence[tuple[float, float, float]]) -> list[str]:
    """``<y, x>`` of each; empty outside of the picture."""
    return _told(front_pixels(np.array(points_m), TEXT_PX).round())


def _told(pixels_K2: NDArray[np.float64]) -> list[str]:
    return [f"<{y}, {x}>" if min(y, x) >= 0 and max(y, x) <= TEXT_PX else "" for y, x in pixels_K2.astype(int).tolist()]


def _onward(now: str, whence: str, rest: str) -> str:
    """The place, and where it will come to rest if that is another one and it can be seen to have left."""
    is_underway = has_moved(now, rest, _UNDERWAY_PX) and has_moved(now, whence, _UNDERWAY_PX)
    return f"{now}{_TO}{rest}" if is_underway else now


def without_end(note: str) -> str:
    """The note without the places where things will come to rest."""
    return _END.sub("", note)


def ends_of_moves(texts: Sequence[str]) -> tuple[list[str], list[str]]:
    """The captions of a demonstration, one a control step, with things that are watched where they last were at rest,
    and where they next will be.

    They are while they move by a pixel at most in five steps; between two swaps that is a moment.
    """
    last: list[str] = []
    coming: list[str] = []
    for is_watched, run in groupby(texts, key=lambda text: text.startswith(_WATCHED)):
        captions = [*run]
        last += _at_rest(captions[::-1])[::-1] if is_watched else captions
        coming += _at_rest(captions) if is_watched else captions
    return last, coming


def _at_rest(texts: Sequence[str]) -> Sequence[str]:
    told = [[(int(y), int(x)) for y, x in PLACE.findall(text)] for text in texts]
    if len({len(each) for each in told}) > 1 or not told[0]:  # something comes into sight, or nothing is
        return texts
    places_TK2 = np.array(told)
    last = len(texts) - 1
    before, after = (np.arange(last + 1) + shift for shift in (-2, 2))
    moves_TK2 = places_TK2[after.clip(max=last)] - places_TK2[before.clip(min=0)]
    moves_TK = np.abs(moves_TK2).max(axis=-1) > 1
    for tick in range(last - 1, -1, -1):
        moves_K = moves_TK[tick]
        places_TK2[tick, moves_K] = places_TK2[tick + 1, moves_K]
    return [_WATCHED + ", ".join(f"<{y}, {x}>" for y, x in places_K2) for places_K2 in places_TK2.tolist()]


def in_sight(note: str, eyes: Eyes) -> str:
    """The note without the places that PONDER's ``eyes`` on the first camera do not show."""
    if eyes is None:
        return note
    boxes = [eye.box for eye in eyes if eye.camera == 0]
    told = (
        PLACE.sub(lambda place: place[0] if any(_is_in(box, place) for box in boxes) else "", part)
        for part in PARTS.split(note)
    )
    # of two places that "to" joins one may be left
    told = (" ".join(part.removeprefix(_TO).removesuffix(_TO).split()) for part in told)
    return ", ".join(part for part in told if part)


def _is_in(box: tuple[float, float, float, float], place: re.Match[str]) -> bool:
    top, left, bottom, right = (TEXT_PX * side for side in box)
    return top <= int(place[1]) < bottom and left <= int(place[2]) < right


def demo_notes(
    texts: Sequence[str],
    tools: Sequence[str],
    moving: Sequence[str],
    moves: tuple[Sequence[str], Sequence[str]] | None = None,
    laid_out: str = "",
) -> list[str]:
    """What is noted at every instant of a demonstration, places as texts tell them; ``""`` for nothing.

    Where things move by the clock alone, where they are. Else every deed that a narration tells (`told_deeds`), with
    its number, when the tool is nearest to its place; of a way around things also where it leads and on which side it
    passes one, when the tool is there: that is seen then, and told at the end of the stretch. Of pegs at the first look
    where the near end and the far one of each lies, for nothing hides them then; of the one that is grasped the same
    two, then; when it is lifted, at which end, that one before the other; and when it is in, from which side. And where
    a thing that will be asked for may change places afterwards, its place from then on: "second <y, x>". Which of the
    deeds was asked for is then one thing to find out, and where it was done another, to be looked up by that word.

    Args:
        texts: what is done in each of D instants, grounded; its places followed (`pp-collect --texts follow`).
        tools: where the tool is then, ``<y, x>``.
        moving: `moving_places` of these instants.
        moves: `ends_of_moves` at these instants; None: nothing changes places.
        laid_out: `laid_out_places` of the scene.
    """
    if any(moving) or len(tools) != len(texts):
        return list(moving)
    found, done, before, told = [""] * len(texts), -1, "", told_deeds(texts)
    for number, deed in enumerate(told, 1):
        # the end of a stretch is where the next one begins
        last = min(deed.last + int(WAY.search(texts[deed.last]) is not None), len(texts) - 1)
        instants = range(min(max(deed.first, done + 1), last), last + 1)
        how = manner(texts[last])
        if how.endswith(" end") and (grasped := _nearest(instants, tools, deed.place)) < last:
            # fingers hide which of both they hold; that is seen when the peg is lifted
            found[grasped] = ends(texts[last]) or deed.place
        if how:  # on its way to one side the hand may pass over the other one
            instants = range(last, last + 1)
        done = _nearest(instants, tools, deed.place)
        side = course(texts[deed.last])
        whence, before = before or tools[instants.start], deed.place
        if side and _half_way(instants, tools, whence, deed.place) == len(texts) - 1:
            # as far as it is seen to go: nobody knows in the middle of a stretch that this is all
            found[-1] = f"{number} {side}"
            continue
        if side and (way := range(instants.start, done)):
            found[_half_way(way, tools, tools[way.start], deed.place)] = f"{number} {side}"
        found[done] = f"{found[done]}, {deed.words}" if found[done] else deed.words
        if deed.words == deed.place:  # the one that was picked up: it stays in view, and may move
            found[done : deed.last + 1] = [deed.place] * (deed.last + 1 - done)
    if laid_out and found:
        found[0] = ", ".join(filter(None, (laid_out, found[0])))
    which: str | None = None
    is_picked_alone = any(PLACE.fullmatch(note) for note in found)
    for instant, captions in enumerate(zip(texts, *(moves or (texts, texts)), strict=True)):
        still = [match for match in map(_STILL.fullmatch, captions) if match is not None]
        if len(still) < len(captions) or not any(found[:instant]):
            continue
        if is_picked_alone:
            found[instant] = _onward(*(match[1] or match[2] for match in still))
        elif still[0][3]:  # of the cube, and of where it will have to be put, this is the one that may move
            which = _which(told, still[0][3]) if which is None else which
            found[instant] = f"{which} {_onward(*(match[3] for match in still))}".lstrip()
    return found


def _nearest(instants: range, tools: Sequence[str], place: str) -> int:
    """Of these instants the one in which the tool is nearest to a place; the first if there is none."""
    return min(instants, key=lambda instant: apart_px(tools[instant], place) or 0.0)


def _which(told: Sequence[Told], place: str) -> str:
    """By which word the deed that was done there was told, as in "second"; empty where none was."""
    there = {
        away_px: each.words.removesuffix(f" {each.place}")
        for each in told
        if each.words.endswith(each.place) and (away_px := apart_px(each.place, place)) is not None
    }
    return there[min(there)] if there and min(there) <= _SAME_PX else ""


def _half_way(way: range, tools: Sequence[str], begin: str, end: str) -> int:
    """Of these instants the one in which the tool is half-way between two places, in columns: rows are what it leaves
    its line in."""
    start, stop = _column(begin), _column(end)
    return min(way, key=lambda instant: abs(_column(tools[instant]) - (start + stop) / 2))


def _column(place: str) -> int:
    found = PLACE.search(place)
    return 0 if found is None else int(found[2])


def noted(instruction: str, subgoals: Sequence[str], moving: Sequence[str]) -> list[str]:
    """What is said at each of T ticks while anything moves by itself: subgoal and notes; ``""`` where nothing does.

    ``subgoals``: T texts without plans; ``moving``: what PONDER sees of it. What is to be stopped is followed while the
    hand waits for it.
    """
    pace = rhythm(instruction, subgoals)
    if pace is None:
        return [f"{text}, {places}" if text and places else "" for text, places in zip(subgoals, moving, strict=True)]
    return [
        "" if wait is None else _paced(text, places, pace, wait, tick)
        for tick, (text, places, wait) in enumerate(zip(subgoals, moving, waits(subgoals), strict=True))
    ]


def _paced(text: str, places: str, pace: int, wait: int, tick: int) -> str:
    told = [text, places] if places else [text]
    if tick >= _PACE_STEPS:
        told += [str(pace), str(wait)]
    return ", ".join(told) if len(told) > 1 else ""


def told_wait(note: str) -> int | None:
    """The number of steps that a note ends with, behind a pace; None where it tells none."""
    told = _WAIT.search(note)
    return None if told is None else int(told[1])


def misnoted(
    instruction: str,
    subgoals: Sequence[str],
    moving: Sequence[str],
    ticks: Sequence[int],
    rng: np.random.Generator,
) -> list[str]:
    """Per query, at these ticks of T, notes of another pace: at the first ones that tell any; ``""`` elsewhere.

    A pace that is always right is copied from the last words and not looked for; so some are wrong, and put right.
    """
    found, pace, left = [""] * len(ticks), rhythm(instruction, subgoals), waits(subgoals)
    paced_at = [n for n, tick in enumerate(ticks) if left[tick] is not None and tick >= _PACE_STEPS]
    if pace is None or not paced_at:
        return found
    other = int(rng.choice([each for each in PASS_STEPS if each != pace]))
    for n in paced_at[: int(rng.integers(1, len(paced_at) + 1))]:
        tick = ticks[n]
        due = round((tick + (left[tick] or 0) + PRESS_STEPS) * other / pace) - PRESS_STEPS
        if due > tick:
            found[n] = _paced(subgoals[tick], moving[tick], other, due - tick, tick)
    return found


def heeded(notes: Sequence[str], share: float, rng: np.random.Generator) -> list[bool]:
    """Whether each note is learned: all that tell anything new, and a ``share`` of those that repeat the one before.

    Most notes repeat it, are nearly always right and outweigh the ones in which something moved.
    """
    drawn = (rng.random(len(notes)) < share).tolist()
    return [now != before or is_drawn for (before, now), is_drawn in zip(pairwise(["", *notes]), drawn, strict=True)]


def with_notes(
    words: Sequence[Words], notes_Q: Sequence[str], wrong_Q: Sequence[str], heeded_Q: Sequence[bool]
) -> tuple[Words, ...]:
    """The words of Q queries, with a note wherever there is one; where there is a wrong one it is not to be learned,
    nor where it is not `heeded`."""
    found = []
    for each, note, wrong, is_heeded in zip(words, notes_Q, wrong_Q, heeded_Q, strict=True):
        if wrong or note:
            each = Words(text=wrong or note, is_due=True, is_learned=is_heeded and not wrong)
        found.append(each)
    return tuple(found)
