"""The task's own subgoal in place of PONDER's, for a POUNCE that reads text (paper, 3.1 and Table 3).

It is for evaluation only, with all servers in one thread: over a network nothing guarantees that a text arrives before
its invocation. PONDER's comes inside the invocation.
"""

from __future__ import annotations

from typing import Literal

from dual_system.models.ponder.coordinates import normalised_text
from protocol import messages as m

Source = Literal["ponder", "oracle"]


class OracleText:
    """The task's subgoals of one episode."""

    def __init__(self) -> None:
        self._texts: list[tuple[int, str]] = []

    def clear(self) -> None:
        self._texts.clear()

    def on_subgoal(self, subgoal: m.Subgoal) -> None:
        """Keeps a text of the task's, in the form that PONDER generates, with the tick from which it is valid."""
        if subgoal.kind == m.SubgoalKind.TASK_GROUNDED:
            self._texts.append((subgoal.tick, normalised_text(subgoal.text)))

    def at(self, invocation: m.Invocation) -> str:
        """The task's text at this tick; empty before the first."""
        return next((text for tick, text in reversed(self._texts) if tick <= invocation.tick), "")
