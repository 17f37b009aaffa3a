"""Which subgoal text an invocation gets, for a POUNCE that reads text in place of cognition (paper, 3.1 and Table 3).

The text is PONDER's newest one, or the task's own annotation. Evaluation only, with all servers in one thread: on a
network nothing says that a text came before the invocation that it is for.
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
        """Keeps a text of this source, by the query it was written at, or by the tick from which it holds."""
        if self._source == "ponder" and subgoal.kind == m.SubgoalKind.SUBGOAL and subgoal.query is not None:
            self._texts.append((subgoal.query, subgoal.text))
        elif self._source == "oracle" and subgoal.kind == m.SubgoalKind.TASK_GROUNDED:
            self._texts.append((subgoal.tick, normalised_text(subgoal.text)))  # as PONDER would write it

    def at(self, invocation: m.Invocation) -> str:
        """PONDER's newest text up to the query referred to, or the task's at this tick; empty before there is one."""
        limit = invocation.ref_query if self._source == "ponder" else invocation.tick
        if limit is None:
            return ""
        return next((text for index, text in reversed(self._texts) if index <= limit), "")
