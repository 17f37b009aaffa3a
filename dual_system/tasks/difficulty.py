"""How difficult a scene is: the values that options and tasks share, without a simulator."""

from typing import Final, Literal, get_args

Difficulty = Literal["easy", "medium", "hard"]
DIFFICULTIES: Final[tuple[Difficulty, ...]] = get_args(Difficulty)
