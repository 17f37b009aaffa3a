"""How difficult a scene is, and what is done first in it: words that options and tasks share, without a simulator."""

from typing import Final, Literal, get_args

Difficulty = Literal["easy", "medium", "hard"]
DIFFICULTIES: Final[tuple[Difficulty, ...]] = get_args(Difficulty)
Order = Literal["drawn", "near-first"]
"""What is done first where a task leaves it open: as its layout was drawn, or by a rule that can be seen."""
