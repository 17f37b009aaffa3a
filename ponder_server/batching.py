"""Continuous batching: thoughts of several sessions share forwards, and join and leave between any two of them.

The order is round robin over forwards: the thought that has waited longest decides the length of the next forward,
those that want one of the same length ride along, and whoever was served goes to the end. So a thought of many
forwards (a text) never keeps a short one waiting for more than one forward of each other session, and a session that
asks more often than others is not served more often.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from ponder_server.contract import Outcome, Progress, SessionError
from ponder_server.runner import Append, Runner
from ponder_server.writer import Steps

Result = TypeVar("Result")


@dataclass(slots=True, eq=False)
class _Thought(Generic[Result]):
    session: str
    steps: Steps[Result]
    request: Append
    turn: int
    """Whoever has the smallest waits longest."""


class Batch(Generic[Result]):
    """Thoughts on their way, at most one of a session."""

    def __init__(self, runner: Runner, *, max_rows: int) -> None:
        self._runner = runner
        self._max_rows = max_rows
        self._waiting: list[_Thought[Result]] = []
        self._ended: list[Outcome[Result]] = []
        self._next_turn = 0

    @property
    def sessions(self) -> tuple[str, ...]:
        """Whose thoughts are on their way, longest waiting first."""
        return tuple(thought.session for thought in self._waiting)

    def __bool__(self) -> bool:
        return bool(self._waiting or self._ended)

    def turn(self) -> int:
        """A place at the end of the queue, for a thought that is added later."""
        self._next_turn += 1
        return self._next_turn

    def add(self, session: str, steps: Steps[Result], turn: int) -> None:
        """Starts a thought; what it raises before its first append is its outcome."""
        assert session not in self.sessions, f"{session!r} is thinking already"
        try:
            request = next(steps)
        except StopIteration as stop:  # it wants nothing appended
            self._ended.append(Outcome(session, stop.value))
        except Exception as error:
            self._ended.append(Outcome(session, None, error))
        else:
            self._waiting.append(_Thought(session, steps, request, turn))
            self._waiting.sort(key=lambda thought: thought.turn)

    def step(self, progress: Progress) -> list[Outcome[Result]]:
        """One forward; the thoughts that ended with it. What interrupts it is told to every thought in it."""
        if group := self._next_group():
            try:
                hidden = self._runner.append([thought.request for thought in group])
                progress()
            except BaseException as error:
                self._abandon(group, error)
                if not isinstance(error, Exception):
                    raise
            else:
                self._waiting = [thought for thought in self._waiting if thought not in group]
                for thought, hidden_NH in zip(group, hidden, strict=True):
                    self._send(thought, hidden_NH)
        ended, self._ended = self._ended, []
        return ended

    def drop(self, session: str) -> None:
        """Forgets a session's thought, which leaves no trace."""
        for thought in [thought for thought in self._waiting if thought.session == session]:
            self._waiting.remove(thought)
            thought.steps.close()

    def _next_group(self) -> Sequence[_Thought[Result]]:
        if not self._waiting:
            return []
        length = self._length(self._waiting[0])
        return [thought for thought in self._waiting if self._length(thought) == length][: self._max_rows]

    def _length(self, thought: _Thought[Result]) -> int:
        return self._runner.bucket(len(thought.request.ids))

    def _send(self, thought: _Thought[Result], hidden_NH: Tensor) -> None:
        try:
            thought.request = thought.steps.send(hidden_NH)
        except StopIteration as stop:
            self._ended.append(Outcome(thought.session, stop.value))
        except Exception as error:
            self._ended.append(Outcome(thought.session, None, error))
        else:
            thought.turn = self.turn()
            self._waiting.append(thought)

    def _abandon(self, group: Sequence[_Thought[Result]], error: BaseException) -> None:
        self._waiting = [thought for thought in self._waiting if thought not in group]
        if isinstance(error, torch.OutOfMemoryError):
            error = SessionError("the device had no memory left for this forward; the session is as it was.")
        for thought in group:
            thought.steps.close()
            if isinstance(error, Exception):
                self._ended.append(Outcome(thought.session, None, error))
