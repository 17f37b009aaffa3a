"""Continuous batching: the queries of several sessions share forward passes, and join and leave between any two.

Forwards are scheduled round robin. The query that has waited longest determines the length of the next forward, others
that need the same length join it, and all of them go to the end of the queue. So a query of many forwards (a text)
never delays another by more than one forward per session, and a session that queries more often is not served more.
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
class _Query(Generic[Result]):
    session: str
    steps: Steps[Result]
    request: Append
    turn: int
    """Place in the queue; the smallest has waited longest."""


class Batch(Generic[Result]):
    """Queries in progress, at most one per session."""

    def __init__(self, runner: Runner, *, max_rows: int) -> None:
        self._runner = runner
        self._max_rows = max_rows
        self._waiting: list[_Query[Result]] = []
        self._ended: list[Outcome[Result]] = []
        self._next_turn = 0

    @property
    def sessions(self) -> tuple[str, ...]:
        """Sessions with a query in progress, longest waiting first."""
        return tuple(query.session for query in self._waiting)

    def __bool__(self) -> bool:
        return bool(self._waiting or self._ended)

    def turn(self) -> int:
        """A place at the end of the queue, for a query that is added later."""
        self._next_turn += 1
        return self._next_turn

    def add(self, session: str, steps: Steps[Result], turn: int) -> None:
        """Starts a query; an exception before its first append is its outcome."""
        assert session not in self.sessions, f"{session!r} has a query in progress"
        try:
            request = next(steps)
        except StopIteration as stop:  # finished without an append
            self._ended.append(Outcome(session, stop.value))
        except Exception as error:
            self._ended.append(Outcome(session, None, error))
        else:
            self._waiting.append(_Query(session, steps, request, turn))
            self._waiting.sort(key=lambda query: query.turn)

    def step(self, progress: Progress) -> list[Outcome[Result]]:
        """Runs one forward; returns the queries that it finished. An exception is the outcome of every query in it."""
        if group := self._next_group():
            try:
                hidden = self._runner.append([query.request for query in group])
                progress()
            except BaseException as error:
                self._abandon(group, error)
                if not isinstance(error, Exception):
                    raise
            else:
                self._waiting = [query for query in self._waiting if query not in group]
                for query, hidden_NH in zip(group, hidden, strict=True):
                    self._send(query, hidden_NH)
        ended, self._ended = self._ended, []
        return ended

    def drop(self, session: str) -> None:
        """Cancels a session's query; the context is as before it."""
        for query in [query for query in self._waiting if query.session == session]:
            self._waiting.remove(query)
            query.steps.close()

    def _next_group(self) -> Sequence[_Query[Result]]:
        if not self._waiting:
            return []
        length = self._length(self._waiting[0])
        return [query for query in self._waiting if self._length(query) == length][: self._max_rows]

    def _length(self, query: _Query[Result]) -> int:
        return self._runner.bucket(len(query.request.ids))

    def _send(self, query: _Query[Result], hidden_NH: Tensor) -> None:
        try:
            query.request = query.steps.send(hidden_NH)
        except StopIteration as stop:
            self._ended.append(Outcome(query.session, stop.value))
        except Exception as error:
            self._ended.append(Outcome(query.session, None, error))
        else:
            query.turn = self.turn()
            self._waiting.append(query)

    def _abandon(self, group: Sequence[_Query[Result]], error: BaseException) -> None:
        self._waiting = [query for query in self._waiting if query not in group]
        if isinstance(error, torch.OutOfMemoryError):
            error = SessionError("the device had no memory left for this forward; the session is as it was.")
        for query in group:
            query.steps.close()
            if isinstance(error, Exception):
                self._ended.append(Outcome(query.session, None, error))
