"""The file of ``--ask``: what a chat model is told, shown and allowed to answer (docs/planners.md)."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from protocol import files

MAX_PICTURES = 64
MAX_SUBGOAL = 300
"""Characters of a subgoal, which becomes a policy's prompt."""

_KIND = "file for --ask"
_OURS = {"model", "messages", "stream", "n", "response_format"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ask:
    """An ask file's contents, checked."""

    prompt: str
    """The robot, its scene, and what a good subgoal is."""
    subgoals: tuple[str, ...] = ()
    """The only subgoals; empty: any."""
    past: int = 8
    """Observations before the newest that are shown again."""
    demo: int = 8
    """Instants of a demonstration that are shown, evenly spread."""
    image_px: int = 512
    """Longest side of a picture as it is sent; larger ones are averaged down by a whole factor."""
    schema: bool = True
    """Whether the request has a JSON schema (`response_format`), by which most servers constrain the reply."""
    request: dict[str, Any] = field(default_factory=dict)
    """Further fields of the request, as the endpoint knows them: temperature, max_tokens, ..."""
    digest: str = ""


def read_ask(path: Path) -> Ask:
    """Reads and checks an ask file.

    Raises:
        OSError, FileError: it cannot be read; a field is missing, unknown or of another type than expected.
    """
    text = files.read_text(path, _KIND)
    with files.reading(path, _KIND):
        given = tomllib.loads(text)
        return _ask(given, hashlib.sha256(text.encode()).hexdigest()[:12])


def _ask(given: dict[str, Any], digest: str) -> Ask:
    if unknown := given.keys() - _READERS.keys():
        raise ValueError(f"unknown field {sorted(unknown)[0]!r}; expected {', '.join(_READERS)}")
    if not isinstance(given.get("prompt"), str) or not given["prompt"].strip():
        raise ValueError("prompt is missing: a text that tells the model about the robot and its subgoals")
    return Ask(**{name: _READERS[name](name, value) for name, value in given.items()}, digest=digest)


def checked_subgoal(text: str) -> str:
    """A subgoal on one line, without outer blanks. Raises ValueError if it is too long, or holds control characters."""
    said = " ".join(text.split())
    if len(said) > MAX_SUBGOAL:
        raise ValueError(f"a subgoal of {len(said)} characters; expected at most {MAX_SUBGOAL}")
    if not said.isprintable():
        raise ValueError(f"a subgoal with characters that cannot be printed: {said[:60]!r}")
    return said


def _prompt(name: str, value: Any) -> str:
    return str(value)


def _subgoals(name: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(each, str) and each.strip() for each in value):
        raise ValueError(f"{name}: expected a list of texts, came {value!r:.80}")
    said = tuple(checked_subgoal(each) for each in value)
    if len({each.casefold() for each in said}) < len(said):
        raise ValueError(f"{name}: one of them is there twice")
    return said


def _count(low: int, high: int) -> Callable[[str, Any], int]:
    def read(name: str, value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"{name}: expected {low} to {high}, came {value!r:.80}")
        return value

    return read


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name}: expected true or false, came {value!r:.80}")
    return value


def _request(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name}: expected a table, came {value!r:.80}")
    json.dumps(value, allow_nan=False)  # TypeError, ValueError: a date, a NaN
    if ours := _OURS & value.keys():
        raise ValueError(f"{name}.{sorted(ours)[0]} is written by ponder-serve; leave it out")
    return value


_READERS: dict[str, Callable[[str, Any], Any]] = {
    "prompt": _prompt,
    "subgoals": _subgoals,
    "past": _count(0, MAX_PICTURES),
    "demo": _count(0, MAX_PICTURES),
    "image_px": _count(32, 4096),
    "schema": _flag,
    "request": _request,
}
