"""Selects an invocation's subgoal text, for a POUNCE that reads text in place of cognition (paper, 3.1 and Table 3).

The text is PONDER's newest one, or the task's own annotation. It is for evaluation only, with all servers in one
thread: over a network nothing guarantees that a text arrives before its invocation.
"""

from __future__ import annotations

from typing import Literal

from dual_system.models.ponder.coordinates import normalised_text
from protocol import messages as m

Source = Literal["ponder", "oracle"]


class SubgoalText:
    """The texts of one episode."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._texts: list[tuple[int, str]] = []

    def clear(self) -> None:
        self._texts.clear()

    def on_subgoal(self, subgoal: m.Subgoal) -> None:
        """Keeps a text of this source with its query, or with the tick from which it is valid."""
        if self._source == "ponder" and subgoal.kind == m.SubgoalKind.SUBGOAL and subgoal.query is not None:
            self._texts.append((subgoal.query, subgoal.text))
        elif self._source == "oracle" and subgoal.kind == m.SubgoalKind.TASK_GROUNDED:
            self._texts.append((subgoal.tick, normalised_text(subgoal.text)))  # in the form that PONDER generates

    def at(self, invocation: m.Invocation) -> str:
        """PONDER's newest text up to the referenced query, or the task's at this tick; empty before the first."""
        limit = invocation.ref_query if self._source == "ponder" else invocation.tick
        if limit is None:
            return ""
        return next((text for index, text in reversed(self._texts) if index <= limit), "")
