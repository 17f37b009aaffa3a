"""A stand-in for cognition: the oracle's subgoal as numbers, for networks that have no pretrained weights.

A pretrained PONDER and a pretrained POUNCE already share what words and places mean. From scratch they do not, and
each is the other's only teacher. The stand-in cuts that knot: POUNCE first learns to act from it, PONDER first learns
to say the subgoal and to carry it in this form, and then both are trained together, end to end, without it. Nothing
here is learned, so the two first stages need not wait for each other. Serving never sees it.

Layout of one carrier's H numbers, rms 1: sines, cosines and the value itself of both coordinates, the rest a fixed
random code of the skill that it asks for: the text without its coordinates, and without what the hand need not know.
Of more than `MOST_NUMBERS` the others are zero and not asked for: a PONDER may grow, and what POUNCE has learned to
read stays where it was.
"""

# H hidden size, K carriers

from __future__ import annotations

import functools
import hashlib
import re

import numpy as np
from numpy.typing import NDArray

from dual_system.models.place_code import NUM_PLACE_FEATURES, PLACE_PX, VALUE_SCALE, WAVE_PX, place_features
from dual_system.training.insertions import manner
from dual_system.training.places import PLACE

MOST_NUMBERS = 128
"""That a stand-in tells anything in."""

_AT = r"( at <>)?"
_PICK = "pick up the first highlighted cube"
_THEN = ", then "
_THEN_WEIGHT = 0.6
_SKILLS = tuple(
    (re.compile(words), skill)
    for words, skill in (
        (r", which is \w+", ""),
        (rf"^pick up the correct cube{_AT} for the \w+ time$", rf"{_PICK}\1"),
        (rf"^pick up the (?:red|green|blue) cube{_AT} for the \w+ time$", rf"{_PICK}\1, then place it"),
        (rf"^[Pp]ick up the cube{_AT}$", rf"{_PICK}\1, then place it"),
        (rf"^pick up the \w+ (?:red|green|blue) cube{_AT}$", rf"{_PICK}\1, then drop it"),
        (rf"^pick up the (?:red|green|blue) cube{_AT}$", rf"{_PICK}\1, then swing it"),
        (rf"^pick up the container{_AT} that hides the \w+ cube$", r"pick up the container\1"),
        (rf"^press the (?:first |second )?button{_AT}(?: to stop| to finish)?$", r"press the button\1"),
        (rf"^place the (?:\w+ cube onto the|cube onto the correct) target{_AT}$", r"place the cube onto the target\1"),
        (rf"^move to the top of the \w+-side target{_AT} for the \w+ time$", r"move to the top of the target\1"),
        (rf"^press the button to stop the cube on the target{_AT}$", "press down"),
        (r"^move (?:forward|backward|left|right)(?:-left|-right)?( to <>)?(, then <>)?$", r"point the stick\1\2"),
        (r"^put (?:the \w+ cube on the table|it down)$", "place the cube onto the table"),
    )
)
"""What one skill is called in several tasks, by one name. Of PickHighlight only a cube's colour is left out: POUNCE may
tell its first from its second."""
_LAST_SWING = re.compile(r"^move to the top of the left-side target.* for the (\w+) time$")
_SWINGS = re.compile(r" repeating this back-and-forth motion (\w+) times,")
_ORDINAL_OF = {"two": "second", "three": "third", "four": "fourth", "five": "fifth"}
_SECOND_PLACE_SEED = 2
_MAX_EVEN_WEIGHT = 64.0
_NOWHERE = (PLACE_PX // 2, PLACE_PX // 2)
_AHEAD_PX = 60.0


@functools.lru_cache(maxsize=1 << 16)
def stand_in(subgoal: str, size: int, instruction: str = "", onward: str = "") -> NDArray[np.float32]:
    """Returns the stand-in (size,) for a grounded subgoal, ``<y, x>`` in pixels of a 256 px picture.

    The first coordinates are the place; a subgoal without any points at the middle. Second ones, where the skill leads
    from one place to another, are within its code; without, those of ``onward`` are, where it goes on afterwards. Of a
    peg or a hole (`insertions`) both ends are told, and the second only tells in which direction it lies. The
    instruction tells what follows where the subgoal does not (`skill_of`).

    Raises:
        ValueError: ``size`` leaves no room for the text's code.
    """
    num_code = min(size, MOST_NUMBERS) - NUM_PLACE_FEATURES
    if num_code < NUM_PLACE_FEATURES:
        raise ValueError(f"a stand-in of {size} numbers is too small; expected at least {2 * NUM_PLACE_FEATURES}")
    place = PLACE.search(subgoal)
    yx_px = (int(place[1]), int(place[2])) if place else _NOWHERE
    rest = np.zeros(size - NUM_PLACE_FEATURES - num_code, np.float32)
    values = np.concatenate([place_features(yx_px), _skill_code(subgoal, instruction, onward, num_code), rest])
    values.flags.writeable = False
    return values


@functools.lru_cache(maxsize=1 << 16)
def skill_of(subgoal: str, instruction: str = "") -> str:
    """What the hand is to do, wherever it is and with whatever: "press the button at <>".

    What is picked up is carried on in a way of each task's own, and that is part of it. The hand hears of the next
    subgoal up to 1.3 s after it has begun and acts for one more second on what it knew, so it must know what follows: a
    hand that was told the same in PickHighlight, where cubes are put down where they were, and in PickXtimes let go of
    the cube half-way. Of SwingXtimes' swings the last is another skill, and only the instruction tells which it is.
    """
    text = PLACE.sub("<>", subgoal)
    is_last = _is_last_swing(text, instruction)
    for words, skill in _SKILLS:
        text = words.sub(skill, text)
    return f"{text}{_THEN}put it down" if is_last else text


def _is_last_swing(text: str, instruction: str) -> bool:
    swing, swings = _LAST_SWING.match(text), _SWINGS.search(instruction)
    if swing is None or not instruction:
        return False
    return swing[1] == (_ORDINAL_OF.get(swings[1]) if swings else "first")


def number_weights(size: int, *, evenly: bool) -> NDArray[np.float32]:
    """How much each number's squared error counts, (size,); a mean over all is one over those of a stand-in.

    ``evenly``: so that a place counts alike in all that tell it. A place 5 px off changes a wave of 16 px by all that
    it can change, and the plain coordinate by a fifteenth of its spread: left alone, the slow numbers may say another
    place than the fast ones at next to no loss. What turns once in 64 px or less counts once, and nothing more than 64
    times.
    """
    weights = np.zeros(size, np.float32)
    weights[:MOST_NUMBERS] = 1.0
    if evenly:
        slopes = 2**0.5 * 2 * np.pi / np.repeat(WAVE_PX, 2)
        place = np.concatenate([slopes, slopes, np.full(2, VALUE_SCALE / PLACE_PX)])
        even = np.clip((slopes[WAVE_PX.index(64) * 2] / place) ** 2, 1.0, _MAX_EVEN_WEIGHT)
        weights[:NUM_PLACE_FEATURES] = even[:size]
    return weights * np.float32(size / min(size, MOST_NUMBERS))


def _skill_code(subgoal: str, instruction: str, onward: str, size: int) -> NDArray[np.float32]:
    code = text_code(skill_of(subgoal, instruction), size)
    places = [*PLACE.findall(subgoal)[1:], *PLACE.findall(onward)]
    if not places:
        return code
    second: tuple[float, float] = int(places[0][0]), int(places[0][1])
    if manner(subgoal) and len(told := PLACE.findall(subgoal)) > 1:
        second = _ahead((int(told[0][0]), int(told[0][1])), second)
    return _mixed(code, _second_place(size) @ place_features(second))


def _ahead(first: tuple[int, int], second: tuple[float, float]) -> tuple[float, float]:
    """A place in the direction of the second one from the first, far enough away to tell that direction.

    A peg's ends lie some ten pixels apart. Told as they are, a hand closed turned by up to 66 degrees from it. Other
    second places are where it goes on to, and need not be read as exactly.
    """
    away = np.subtract(second, first)
    y, x = np.array(first) + away * (_AHEAD_PX / max(float(np.hypot(*away)), 1.0))
    return float(y), float(x)


def _mixed(code: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float32]:
    """The first with so much of the second in it that both can be told; rms 1 where they are."""
    return np.sqrt(1 - _THEN_WEIGHT**2).astype(np.float32) * code + _THEN_WEIGHT * other


@functools.lru_cache(maxsize=1 << 4)
def _second_place(size: int) -> NDArray[np.float32]:
    """How the numbers of a second place lie among those of a code, (size, NUM_PLACE_FEATURES)."""
    drawn = np.random.default_rng(_SECOND_PLACE_SEED).normal(size=(size, NUM_PLACE_FEATURES))
    return (drawn / NUM_PLACE_FEATURES**0.5).astype(np.float32)


@functools.lru_cache(maxsize=1 << 10)
def text_code(text: str, size: int) -> NDArray[np.float32]:
    """Drawn from the text alone: nearly orthogonal to every other's, but for the same thing that goes on otherwise."""
    first, _, then = text.partition(_THEN)
    if then:
        return _mixed(text_code(first, size), text_code(then, size))
    seed = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
    return np.random.default_rng(seed).normal(size=size).astype(np.float32)
