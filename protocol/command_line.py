"""Parses command lines into frozen dataclasses, with docstrings as ``--help`` and one flag per switch.

A switch that is off by default has ``--x``; one that is on has only ``--no-x``, so its docstring says "Do not ...".
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
    """Returns the options in ``argv`` (None: the process's). Exits the process after ``--help`` or an error."""
    return tyro.cli(kind, args=argv, prog=prog, description=kind.__doc__, config=(tyro.conf.FlagCreatePairsOff,))


def flat(options: Any) -> dict[str, Any]:
    """Options as JSON values by their names on the command line, without groups."""
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
