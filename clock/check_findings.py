"""Disagreements between a log and the rules, and the exact comparison that finds them: floats bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Disagreement:
    """``message`` number ``index`` has ``found`` in ``field`` where the rules give ``expected``."""

    message: str
    index: int
    field: str
    expected: str
    found: str

    def __str__(self) -> str:
        return f"{self.message} {self.index}.{self.field}: expected {self.expected}, found {self.found}"


def compare(message: str, index: int, /, **pairs: tuple[Any, Any]) -> Iterator[Disagreement]:
    """Yields each field whose (expected, found) differ, in the order given. Arrays are equal when their bytes are."""
    for field, (expected, found) in pairs.items():
        if isinstance(expected, np.ndarray):
            if expected.shape != found.shape:
                shapes = f"shape {expected.shape}", f"shape {found.shape}"
                yield Disagreement(message=message, index=index, field=field, expected=shapes[0], found=shapes[1])
            elif expected.tobytes() != found.tobytes():
                at = int(np.flatnonzero(expected.view(np.uint32).ravel() != found.view(np.uint32).ravel())[0])
                values = repr(float(expected.flat[at])), repr(float(found.flat[at]))
                yield Disagreement(
                    message=message, index=index, field=f"{field}[{at}]", expected=values[0], found=values[1]
                )
        elif expected != found:
            yield Disagreement(message=message, index=index, field=field, expected=_text(expected), found=_text(found))


def _text(value: Any) -> str:
    return str(getattr(value, "name", value))
