"""Which episodes have weights of their own: a specialist reads what an instruction says it is for.

A small network that learns one more thing forgets a little of all others. A specialist is layers of its own for
episodes of one kind (a `Reader` that reads them from the first token to the last, or, where a demonstration has a
reader of its own, what that leaves), and everybody else's stay as they are. Which kind an episode is of its instruction
tells. The paper has one network for all.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Specialty:
    """A specialist's name, and what it is for; part of a PONDER's checkpoint."""

    name: str
    instructions: str
    """A regular expression, searched for whatever its case."""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"a specialist is named by small letters, digits and underscores, came {self.name!r}")
        try:
            re.compile(self.instructions)
        except re.error as error:
            raise ValueError(
                f"specialist {self.name}: {self.instructions!r} is no regular expression, {error}"
            ) from None

    def is_for(self, instruction: str) -> bool:
        return re.search(self.instructions, instruction, re.IGNORECASE) is not None


def check_specialties(specialties: Sequence[Specialty]) -> None:
    """Raises ValueError if two have one name."""
    names = [each.name for each in specialties]
    if len(set(names)) < len(names):
        raise ValueError(f"specialists need names of their own, came {', '.join(names)}")


def specialist_for(specialties: Sequence[Specialty], instruction: str) -> str | None:
    """The name of the first that is for it; None: nobody is."""
    return next((each.name for each in specialties if each.is_for(instruction)), None)
