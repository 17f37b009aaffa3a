"""Subgoal texts: one template per subtask, a plain and a grounded reading of it, and when the grounded one is fixed.

In a template, the part of the grounded text alone is in brackets, and ``<>`` is a coordinate: "press the button[
at <>]" reads "press the button", or "press the button at <69, 99>" with the row first. Templates are upstream's,
typos included.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

ALL_DONE = "All tasks completed"
ORDINALS = ("first", "second", "third", "fourth", "fifth")
COUNTS = ("one", "two", "three", "four", "five")

Pixel = tuple[int, int]  # row, column


def simple(template: str) -> str:
    """Returns the template without its bracketed parts."""
    return re.sub(r"\[[^]]*\]", "", template)


def counted_cubes(counts: Mapping[str, int]) -> str:
    """How many cubes of which color, in this order: "two red cubes, one green cube and three blue cubes"."""
    parts = [f"{COUNTS[count - 1]} {color} cube{'s' * (count > 1)}" for color, count in counts.items()]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def num_coordinates(template: str) -> int:
    """Returns how many coordinates the grounded text needs."""
    return template.count("<>")


def grounded(template: str, points_yx_px: Sequence[Pixel]) -> str:
    """Returns the template with its bracketed parts and its coordinates filled in order.

    Raises ValueError if the number of points is not the number of places.
    """
    if len(points_yx_px) != num_coordinates(template):
        raise ValueError(
            f"template {template!r} takes {num_coordinates(template)} coordinates; got {list(points_yx_px)}"
        )
    points = iter(points_yx_px)
    text = template.replace("[", "").replace("]", "")
    return re.sub("<>", lambda _: "<{}, {}>".format(*next(points)), text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Caption:
    """The texts delivered with one observation."""

    index: int  # of the subtask they speak of
    simple: str
    grounded: str
    is_latched: bool  # the coordinates are in and stay until the subtask changes


def follow(previous: Caption | None, index: int, template: str, look: Callable[[], list[Pixel] | None]) -> Caption:
    """Returns the texts of subtask ``index``, given those of the observation before.

    ``look`` returns where the subtask's objects are seen, or None while one of them is hidden. It is asked only
    until the coordinates are fixed: they stay where the object was first seen, even if it moves. Until then the
    grounded text is the simple one.
    """
    if previous is not None and previous.index == index and previous.is_latched:
        return previous
    points = look()
    text = simple(template) if points is None else grounded(template, points)
    return Caption(index=index, simple=simple(template), grounded=text, is_latched=points is not None)


def letter(index: int, y_m: Sequence[float]) -> str:
    """Returns what texts call one of several alike: A, B, C ... from the left of the front camera's picture."""
    return chr(ord("A") + sorted(y_m).index(y_m[index]))


def completed(previous: Caption) -> Caption:
    """Returns the texts after the last subtask: the grounded one keeps the last instruction."""
    return replace(previous, simple=ALL_DONE)
