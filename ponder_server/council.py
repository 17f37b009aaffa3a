"""An engine whose answers several readings of the episode have agreed on (`counsel`).

Each view of the scene is a session of its own in one `QwenEngine`, so their forwards are shared like those of
different robots. When all have answered a query the rule decides (`election`); who has said something else takes
it back and says what was elected, told as in its view. So all contexts tell the same story, and the next query begins
from there. Cognition is that of the view as it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from dual_system.models.counsel import Counsel
from dual_system.models.views import View
from ponder_server.contract import (
    EngineSpec,
    Fire,
    Frame,
    Opening,
    Outcome,
    Progress,
    Proprio,
    SessionError,
    no_progress,
)
from ponder_server.election import Said, elected, elected_place
from ponder_server.engine import (
    NUM_MEASURED_FIRES,
    NUM_UNMEASURED_FIRES,
    WARM_UP_OPENING,
    WARM_UP_PROPRIO,
    WARM_UP_SESSION,
    QwenEngine,
)


@dataclass(slots=True, kw_only=True)
class _Session:
    """An episode and its readings."""

    members: dict[str, View]
    """The engine's sessions; the first sees the scene as it is."""
    frames: tuple[Frame, ...] = ()
    proprio: Proprio | None = None
    answers: dict[str, Fire] = field(default_factory=dict)
    """To the query on its way, of those who are done with it."""
    elected: Said | None = None
    """None: not yet."""

    @property
    def first(self) -> str:
        return next(iter(self.members))


class Council:
    """A ``BatchingEngine`` over another, whose sessions it takes ``num_members`` at a time."""

    def __init__(
        self,
        engine: QwenEngine,
        counsel: Counsel,
        views_of: Callable[[str], tuple[View, ...]],
        *,
        max_sessions: int | None = None,
    ) -> None:
        """``views_of``: an instruction's (`Counsel.views`); ``max_sessions``: episodes open at once, if that is to be
        fewer than the engine has contexts for (one that is read in one view takes one)."""
        self._engine = engine
        self._near = counsel.near
        self._on_demonstrations = counsel.on_demonstrations
        self._views_of = views_of
        self._max_sessions = max_sessions
        self.num_members = counsel.num_views
        self._spec = replace(engine.spec, session_bytes=engine.spec.session_bytes * self.num_members)
        self._sessions: dict[str, _Session] = {}
        self._owner: dict[str, str] = {}

    @property
    def spec(self) -> EngineSpec:
        return self._spec

    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        """Opens every reading; see ``PonderEngine.open``."""
        if session not in self._sessions and len(self._sessions) == self._max_sessions:
            raise SessionError(
                f"session {session!r} does not fit: {sorted(self._sessions)} are open and max_sessions is "
                f"{self._max_sessions}. Close one, or raise max_sessions."
            )
        views = self._views_of(opening.instruction)
        if opening.has_demo and not self._on_demonstrations:
            views = views[:1]
        members = {session: views[0]}
        members |= {f"{session}, seen otherwise {n}": view for n, view in enumerate(views[1:], 1)}
        num_tokens = self._engine.open_views(members, opening, progress)
        self._sessions[session] = _Session(members=members)
        self._owner |= dict.fromkeys(members, session)
        return num_tokens

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """One query, alone; see ``PonderEngine.fire``."""
        busy = [name for name, each in self._sessions.items() if each.frames]
        if busy:
            raise SessionError(f"queries of {busy} are being thought about; step until they are done.")
        self.begin(session, frames, proprio=proprio)
        while True:
            for outcome in self.step(progress):
                return outcome.unwrap()

    def begin(self, session: str, frames: tuple[Frame, ...], *, proprio: Proprio | None = None) -> None:
        """Takes on one query for every reading; see ``BatchingEngine.begin``."""
        own = self._session(session)
        if own.frames:
            raise SessionError(f"session {session!r} is thinking about a query already; one at a time.")
        try:
            for member in own.members:
                self._engine.begin(member, frames, proprio=proprio)
        except BaseException:
            for member in own.members:
                self._engine.drop(member)
            raise
        own.frames, own.proprio = frames, proprio

    def step(self, progress: Progress = no_progress) -> list[Outcome[Fire]]:
        """One forward; the queries that all readings are done with, and agree on. See ``BatchingEngine.step``."""
        ended: list[Outcome[Fire]] = []
        failed: dict[str, Exception | None] = {}
        outcomes = self._engine.step(progress)
        for outcome in outcomes:  # all of them first: what failed in this forward takes back what came of it
            session = self._owner[outcome.session]
            if outcome.result is None:
                failed[session] = outcome.error
            else:
                self._sessions[session].answers[outcome.session] = outcome.result
        for session in dict.fromkeys(self._owner[outcome.session] for outcome in outcomes):
            own = self._sessions[session]
            if session in failed:
                self._give_up(own)
                ended.append(Outcome(session, None, failed[session]))
                continue
            if len(own.answers) < len(own.members):
                continue
            try:
                is_agreed = own.elected is not None or self._agree(own)
            except Exception as error:
                self._give_up(own)
                ended.append(Outcome(session, None, error))
                continue
            if is_agreed:
                ended.append(Outcome(session, own.answers[own.first]))
                self._rest(own)
        return ended

    def _agree(self, own: _Session) -> bool:
        """Holds the election; whether everybody has said so already. The others begin anew."""
        said = {member: _said(own.answers[member]) for member in own.members}
        meant = {member: tuple(map(view.meant, said[member])) for member, view in own.members.items()}
        found = {member for member, answer in own.answers.items() if answer.is_second_look}
        own.elected = elected([() if member in found else meant[member] for member in own.members], self._near)
        if not own.elected:
            own.elected = elected_place(
                [meant[member] for member in own.members if member in found], self._near, len(said)
            )
        outvoted = []
        for member, view in own.members.items():
            words = tuple(map(view.seen, own.elected))
            if words != said[member]:
                self._engine.undo(member)
                del own.answers[member]
                outvoted.append((member, words))
        for member, words in outvoted:
            self._engine.begin(member, own.frames, proprio=own.proprio, saying=words)
        return not outvoted

    def _give_up(self, own: _Session) -> None:
        """The query on its way leaves no trace in any reading."""
        for member in own.members:
            self._engine.drop(member)
            if member in own.answers:
                self._engine.undo(member)
        self._rest(own)

    def _rest(self, own: _Session) -> None:
        own.frames, own.proprio, own.answers, own.elected = (), None, {}, None

    def close(self, session: str) -> None:
        """Closes every reading; see ``PonderEngine.close``."""
        own = self._session(session)
        for member in own.members:
            self._engine.close(member)
            del self._owner[member]
        del self._sessions[session]

    def warm_up(self) -> list[int]:
        """Durations in ns of queries with counsel at a short context, after the engine's own warm-up."""
        self._engine.warm_up()
        frames = self._engine.example_frames()
        self.open(WARM_UP_SESSION, WARM_UP_OPENING)
        try:
            durations_ns = []
            for _ in range(NUM_UNMEASURED_FIRES + NUM_MEASURED_FIRES):
                start_ns = time.perf_counter_ns()
                self.fire(WARM_UP_SESSION, frames, proprio=WARM_UP_PROPRIO)
                durations_ns.append(time.perf_counter_ns() - start_ns)
        finally:
            self.close(WARM_UP_SESSION)
        return durations_ns[NUM_UNMEASURED_FIRES:]

    def warm_up_full(self) -> list[int]:
        """As ``BatchingEngine.warm_up_full``, every reading after the other: what is shared is saved."""
        return [duration_ns * self.num_members for duration_ns in self._engine.warm_up_full()]

    def _session(self, session: str) -> _Session:
        own = self._sessions.get(session)
        if own is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._sessions)}.")
        return own


def _said(fire: Fire) -> Said:
    return tuple(text.text for text in fire.texts)
