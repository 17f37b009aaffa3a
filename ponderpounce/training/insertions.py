"""A peg that is put into a box, in words: at which end it is held, and from which side it goes in.

The simulator's texts tell both (`tasks.imitation.insert_peg`), with the places of both ends and of the hole's mouths.
Notes, narration and plan keep the same few words, "far end" and "left side", to be looked up and copied.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

_HELD = re.compile(r"\b(far|near) end\b")
_SIDE = re.compile(r"\b(left|right) side\b")
_DONE = re.compile(rf"Pick up the peg by grasping the ({_HELD.pattern})|Insert the peg from the ({_SIDE.pattern})")
_OTHER = {"far": "near", "near": "far", "left": "right", "right": "left"}
_END, _FROM = 1, 2  # as "stretches" of a way, the numbers of what is done


def manner(text: str) -> str:
    """What this text of the simulator's asks to be done as it was shown: "far end", "left side"; else empty."""
    done = _DONE.match(text)
    return "" if done is None else done[1] or done[3]


def shows_an_insertion(texts: Sequence[str]) -> bool:
    """Whether the simulator's texts tell how a peg is put into a box."""
    return any(map(manner, texts))


def inserted_otherwise(text: str, others: Collection[int]) -> str:
    """The text, or note, told of the other end if 1 is one of ``others``, and of the other side if 2 is."""
    for number, words in ((_END, _HELD), (_FROM, _SIDE)):
        if number in others:
            text = words.sub(lambda told: told[0].replace(told[1], _OTHER[told[1]]), text)
    return text
