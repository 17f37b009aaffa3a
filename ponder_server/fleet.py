"""Several robots, one network: a server per robot, with queries batched in common forwards.

Every robot has its own link, heartbeat and node, exactly as if it were alone; they share the engine, hence its weights
and its queue. A robot is admitted to an episode if no robot's cognition then grows older than that robot allows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from model_server.ends import Ends
from model_server.shell import percentile_ns
from ponder_server.admission import Admission
from ponder_server.contract import (
    BatchingEngine,
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
from ponder_server.node import KEEP_QUERIES, Work
from ponder_server.serve import PonderServer
from protocol import messages as m
from protocol.errors import CallFailed, ProtocolError
from protocol.heartbeat import Heartbeat
from protocol.link import Link


class SharedEngine:
    """One engine, and its answers that were not fetched yet.

    Args:
        between: what else is done between two forwards of an opening, for the robots that play meanwhile.
        beat: every robot's heartbeat.
    """

    def __init__(self, engine: BatchingEngine, beat: Progress, between: Callable[[], None]) -> None:
        self.engine = engine
        self.beat, self.between = beat, between
        self.outcomes: dict[str, Outcome[Fire]] = {}

    def step(self, progress: Progress) -> None:
        for outcome in self.engine.step(progress):
            self.outcomes[outcome.session] = outcome


class RobotEngine:
    """One robot's view of the shared engine: a ``PonderEngine`` with its own sessions."""

    def __init__(self, shared: SharedEngine, robot: str, durations_ns: Sequence[int]) -> None:
        self._shared = shared
        self._robot = robot
        self._durations_ns = list(durations_ns)

    @property
    def spec(self) -> EngineSpec:
        return self._shared.engine.spec

    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        return self._shared.engine.open(self._name(session), opening, self._shared.beat, self._shared.between)

    def begin(self, session: str, frames: tuple[Frame, ...], *, proprio: Proprio | None = None) -> None:
        self._shared.engine.begin(self._name(session), frames, proprio=proprio)

    def fetch(self, session: str) -> Outcome[Fire] | None:
        """The outcome of the session's query; None while it is in progress."""
        return self._shared.outcomes.pop(self._name(session), None)

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """Begins a query and waits for it; the other robots' queries continue meanwhile."""
        self.begin(session, frames, proprio=proprio)
        while (outcome := self.fetch(session)) is None:
            self._shared.step(progress)
        return outcome.unwrap()

    def close(self, session: str) -> None:
        self._shared.outcomes.pop(self._name(session), None)
        self._shared.engine.close(self._name(session))

    def beat(self) -> None:
        self._shared.beat()

    def warm_up(self) -> list[int]:
        """Returns the durations of the engine's common warm-up."""
        return self._durations_ns

    def _name(self, session: str) -> str:
        return f"{self._robot}/{session}"


class RobotServer(PonderServer):
    """PONDER for one of several robots: a query is begun in one step and answered in a later one.

    A lost context is rebuilt in the same way, query by query, so that the other robots' queries take turns with it;
    its own robot's new queries wait until it is rebuilt.
    """

    def __init__(
        self, link: Link, engine: RobotEngine, heartbeat: Heartbeat, version: str, admission: Admission
    ) -> None:
        super().__init__(link, engine, heartbeat, version)
        self._robot_engine = engine
        self._admission = admission
        self._waiting: deque[Work] = deque()
        self._thinking: tuple[Work, int] | None = None
        self._rebuild: _Rebuild | None = None
        self._is_opening = False

    @property
    def is_busy(self) -> bool:
        return self._thinking is not None or self._rebuild is not None

    def step(self) -> bool:
        """Reads messages and publishes answers; the fleet runs the engine in between."""
        worked = self._take_calls()
        return self.work() or worked or (not self.is_busy and self._resume())

    def work(self) -> bool:
        """As ``step``, without calls: what a robot needs while another one's episode is being opened."""
        if self._is_opening:
            return False
        worked = self._listen()
        while len(self._waiting) < KEEP_QUERIES and (work := self._next_work()) is not None:
            self._waiting.append(work)  # taken early: the node keeps observations for ticks, not for seconds
        return self._finish() or self._begin() or worked

    def rejoin(self) -> bool:
        """Asks for the running episode, and begins to rebuild its context."""
        rejoined = self._membership.rejoin()
        if rejoined is None:
            return False
        self._node.open(next_query=rejoined.num_queries)
        self._take_newest(rejoined)
        self._rebuild = _Rebuild(self._missed_work(rejoined.num_queries), rejoined.num_queries, rejoined.owed_query)
        return True

    def _begin(self) -> bool:
        if self._thinking is not None or (work := self._next_rebuilt() or self._next_asked()) is None:
            return False
        try:
            self._robot_engine.begin(self._link.episode, work.frames, proprio=work.proprio)
        except (SessionError, ValueError) as error:
            self._fail(work, error)
        else:
            self._thinking = work, self._begin_inference("fire")
        return True

    def _next_asked(self) -> Work | None:
        return self._waiting.popleft() if self._waiting else None

    def _next_rebuilt(self) -> Work | None:
        """The next query of a rebuild; without one, the rebuild is complete."""
        if self._rebuild is None:
            return None
        try:
            work = next(self._rebuild.missed, None)
        except (CallFailed, ProtocolError) as error:
            self._give_up(error)
            return None
        if work is None:
            num_queries, self._rebuild = self._rebuild.num_queries, None
            self._rebuilt(num_queries)
        return work

    def _finish(self) -> bool:
        if self._thinking is None or (outcome := self._robot_engine.fetch(self._link.episode)) is None:
            return False
        work, start_ns = self._thinking
        self._thinking = None
        self._end_inference()
        if isinstance(outcome.error, ValueError):
            self._fail(work, outcome.error)
        else:
            fire = outcome.unwrap()
            if self._is_owed(work):
                self._answer(work, fire, start_ns)
            else:
                self._node.keep(work.query, fire)
        return True

    def _fail(self, work: Work, error: Exception) -> None:
        if self._is_owed(work):
            self._refuse(work, error)
        else:
            self._give_up(error)

    def _is_owed(self, work: Work) -> bool:
        """Whether the clock waits for the answer; otherwise only the context needs the query."""
        return self._is_shadow or self._rebuild is None or work.query.query == self._rebuild.owed_query

    def _open(self, request: m.OpenRequest) -> m.Contract:
        self._admission.admit(self._link.robot, request.info.schedule)
        self._is_opening = True
        try:
            return super()._open(request)
        finally:
            self._is_opening = False

    def _beat(self) -> None:
        self._robot_engine.beat()

    def _close(self) -> None:
        self._rebuild = None
        self._waiting.clear()
        if self._thinking is not None:
            self._thinking = None
            self._end_inference()
        self._admission.release(self._link.robot)
        super()._close()


@dataclass(frozen=True, slots=True)
class _Rebuild:
    """A lost context that is being rebuilt."""

    missed: Iterator[Work]
    num_queries: int
    owed_query: int | None
    """Query whose answer the clock still waits for (lockstep)."""


class PonderFleet:
    """A ``ModelServer`` for several robots on one bus."""

    def __init__(
        self,
        link: Link,
        engine: BatchingEngine,
        heartbeat: Heartbeat,
        version: str,
        *,
        other_robots: Sequence[str],
    ) -> None:
        """``link`` and ``heartbeat`` are the first robot's."""
        self._ends = Ends(link, heartbeat, version, other_robots)
        self._shared = SharedEngine(engine, self._ends.beat, self._between)
        self._version = version
        self._servers: list[RobotServer] = []

    @property
    def shells(self) -> tuple[RobotServer, ...]:
        return tuple(self._servers)

    def warm_up(self) -> None:
        self._ends.warming()
        durations_ns = self._shared.engine.warm_up()
        full_ns = self._shared.engine.warm_up_full()
        admission = Admission(fire_p50_ns=percentile_ns(full_ns, 50), fire_p99_ns=percentile_ns(full_ns, 99))
        for link, heartbeat in self._ends:
            engine = RobotEngine(self._shared, link.robot, durations_ns)
            self._servers.append(RobotServer(link, engine, heartbeat, self._version, admission))
        for server in self._servers:
            server.warm_up()

    def ready(self) -> None:
        for server in self._servers:
            server.ready()

    def step(self) -> bool:
        """Reads every robot's messages, then runs one forward for those with queries."""
        worked = [server.step() for server in self._servers]
        self._shared.step(self._shared.beat)
        return any(worked) or any(server.is_busy for server in self._servers)

    def _between(self) -> None:
        """A turn for the robots that play, between two forwards of another one's opening."""
        for server in self._servers:
            server.work()
        self._shared.step(self._shared.beat)
