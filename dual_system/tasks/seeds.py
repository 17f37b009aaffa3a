"""Splits of the tasks' scenes by seed: which are trained on, which a design is chosen on, and which measure it once.

They are splits of the scenes that are drawn here. Seeds of RoboMME itself, or of other tasks and robots, are other
scenes, whatever their number, so every check looks at where an episode is from first.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import Literal

from protocol.errors import CommandError

Split = Literal["demo", "development", "test", "reserved", "rollouts", "collection"]
"""What a seed's scene is for.

demo: examples, demos and the tests of this repository. development: whatever is tried, chosen or probed. test: a final
measurement. reserved: test scenes of later measurements, which nothing may play yet. rollouts: a policy's episodes that
are to be corrected or trained on. collection: the oracle's episodes that are trained on.
"""

_BEGINNINGS: tuple[tuple[int, Split], ...] = (
    (0, "demo"),
    (500_000, "development"),
    (800_000, "test"),
    (800_100, "demo"),
    (810_000, "reserved"),
    (810_100, "demo"),
    (820_000, "reserved"),
    (820_100, "demo"),
    (1_000_000, "rollouts"),
    (2_000_000, "collection"),
)
"""Where each range of seeds begins; it ends where the next one begins."""
_STARTS = tuple(start for start, _ in _BEGINNINGS)
_END = 2**63

FIRST_COLLECTION_SEED = _STARTS[-1]
HELD_OUT = frozenset[Split]({"test", "reserved"})
"""Splits that no dataset may hold."""
UNTRAINED = HELD_OUT | frozenset[Split]({"development"})
"""Splits that nothing may train on."""


class SeedError(CommandError):
    """Seeds of a split that a program must not use, or of two; the message says which, and the way out."""


def split_of(seed: int) -> Split:
    """Returns the split of a scene's seed."""
    return _BEGINNINGS[_range_of(seed)][1]


def seeds_from(seed: int) -> range:
    """Returns the seeds from this one on that lie in the same range of the same split."""
    place = _range_of(seed)
    return range(seed, _STARTS[place + 1] if place + 1 < len(_STARTS) else _END)


def scenes(num_scenes: int, *, split: Split | None = None, seed: int | None = None) -> range:
    """Returns the seeds of scenes that follow each other.

    Args:
        num_scenes: their number.
        split: the split they are to be of; None: that of ``seed``, if it is none that has to be named.
        seed: the first of them; None: the split's first, or 0.

    Raises:
        SeedError: the seeds are of another split, of two, or of one that is not played.
    """
    first = _first_of(split or "demo") if seed is None else seed
    if first < 0:
        raise SeedError(f"seed {first}: seeds of scenes are at least 0")
    found, room = split_of(first), seeds_from(first)
    if split is not None and found != split:
        raise SeedError(f"seed {first} is of the {found} split, not of {split}, which begins at {_first_of(split)}")
    if found == "test" and split is None:
        raise SeedError(
            f"seed {first} is of the test split, which is played when everything is decided and only if it is named "
            f"(pp-eval --split test); development scenes begin at {_first_of('development')}"
        )
    if found in ("reserved", "collection"):
        why = "kept for later measurements" if found == "reserved" else "the training data's"
        raise SeedError(
            f"seed {first} is {why} ({found} split); development scenes begin at {_first_of('development')}"
        )
    if num_scenes > len(room):
        raise SeedError(
            f"seeds {first} to {first + num_scenes - 1} leave the {found} split, whose range ends at {room[-1]}: "
            f"take at most {len(room)} scenes, or begin earlier"
        )
    return room[:num_scenes]


def require_open(seed: int, way_out: str) -> None:
    """Raises SeedError for a scene that is held out from whatever is no final measurement."""
    if split_of(seed) in HELD_OUT:
        raise SeedError(f"seed {seed} is of the {split_of(seed)} split, which is kept for measurements; {way_out}")


def _range_of(seed: int) -> int:
    return max(bisect_right(_STARTS, seed) - 1, 0)


def _first_of(split: Split) -> int:
    return next(start for start, name in _BEGINNINGS if name == split)
