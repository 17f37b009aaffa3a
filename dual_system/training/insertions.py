"""A peg that is put into a box, in words: at which end it is held, and from which side it goes in.

The simulator's texts tell both (`tasks.imitation.insert_peg`), with the places of both ends and of the hole's mouths.
Notes, narration and plan keep the same few words, "far end" and "left side", and the same places, to be looked up and
copied: of ends first the held one.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from dual_system.training.places import ONE_PLACE, PLACE

_HELD = re.compile(r"\b(far|near) end\b")
_SIDE = re.compile(r"\b(left|right) side\b")
_DONE = re.compile(rf"Pick up the peg by grasping the ({_HELD.pattern})|Insert the peg from the ({_SIDE.pattern})")
_PAIR = re.compile(rf"((?:far|near) end(?: at)? )({ONE_PLACE}), ({ONE_PLACE})")
_OTHER = {"far": "near", "near": "far", "left": "right", "right": "left"}
_END, _FROM = 1, 2  # as "stretches" of a way, the numbers of what is done


def manner(text: str) -> str:
    """What this text of the simulator's asks to be done as it was shown: "far end", "left side"; else empty."""
    done = _DONE.match(text)
    return "" if done is None else done[1] or done[3]


def ends(text: str) -> str:
    """Of this text of the simulator's, of a peg that is picked up, the places of its near end and of its far one."""
    pair = _PAIR.search(text)
    if pair is None:
        return ""
    held, other = pair[2], pair[3]
    return f"{held}, {other}" if manner(text).startswith("near") else f"{other}, {held}"


def in_words(text: str) -> str:
    """What this text of the simulator's asks to be done, and where: "far end <y, x>, <v, u>", "left side <y, x>"; empty
    for other texts, and where it tells no place."""
    how, places = manner(text), [place[0] for place in PLACE.finditer(text)]
    return f"{how} {', '.join(places[: 2 if how.endswith(' end') else 1])}" if how and places else ""


def shows_an_insertion(texts: Sequence[str]) -> bool:
    """Whether the simulator's texts tell how a peg is put into a box."""
    return any(map(manner, texts))


def inserted_otherwise(text: str, others: Collection[int]) -> str:
    """The text, or note, told of the other end if 1 is one of ``others``, and of the other side if 2 is.

    What is held is then what lay at the other place; a mouth's place stays.
    """
    if _END in others:
        text = _PAIR.sub(r"\1\3, \2", text)
    for number, words in ((_END, _HELD), (_FROM, _SIDE)):
        if number in others:
            text = words.sub(lambda told: told[0].replace(told[1], _OTHER[told[1]]), text)
    return text
