"""One way to read a command line: a frozen dataclass, its docstrings as ``--help``, one flag per switch.

A switch that is off has ``--x``; one that is on has ``--no-x`` alone, so its docstring says what *not* to do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from protocol.options import LinkOptions

Options = TypeVar("Options")


def parse(kind: type[Options], argv: Sequence[str] | None, *, prog: str) -> Options:
    """Returns the options of ``argv``; None: of the process. Leaves the process after ``--help`` or a mistake."""
    return tyro.cli(kind, args=argv, prog=prog, description=kind.__doc__, config=(tyro.conf.FlagCreatePairsOff,))


def flat(options: Any) -> dict[str, Any]:
    """Options as JSON holds them, by their names on the command line: groups do not show."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, LinkOptions):
            found |= flat(value)
        else:
            found[field.name] = _plain(value)
    return found


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return flat(value)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
