"""Several robots, one network: a server per robot, with invocations that wait together answered in one batch.

Every robot has its own link, heartbeat and node, as if it were alone. Turns are fair: a robot has at most one
invocation in a batch, and the one that was answered longest ago comes first: asking more often earns no more rows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model_server.ends import Ends
from model_server.shell import percentile_ns
from pounce_server.admission import Admission
from pounce_server.contract import BatchingEngine, example_request
from pounce_server.node import Work
from pounce_server.serve import PounceServer
from protocol import messages as m
from protocol.heartbeat import Heartbeat
from protocol.link import Link

NUM_MEASURED_BATCHES = 10


class RobotServer(PounceServer):
    """POUNCE for one of several robots: it reads messages and publishes rows; the fleet runs the engine in between."""

    def __init__(
        self, link: Link, engine: BatchingEngine, heartbeat: Heartbeat, version: str, admission: Admission
    ) -> None:
        super().__init__(link, engine, heartbeat, version)
        self._admission = admission
        self._num_replaced = 0
        self.waiting: Work | None = None
        """The newest invocation, from its observation's arrival to its batch."""
        self.answered_ns = 0
        """When this robot was last in a batch (monotonic)."""

    @property
    def num_superseded(self) -> int:
        return super().num_superseded + self._num_replaced

    def step(self) -> bool:
        """Reads all messages; returns whether there is anything to do because of them. The fleet does it."""
        worked, work = self._listen()
        if work is not None:
            self._num_replaced += self.waiting is not None
            self.waiting = work
        return worked or work is not None

    def take(self) -> Work:
        """Removes the waiting invocation, and reports that it is being answered."""
        work, self.waiting = self.waiting, None
        assert work is not None, "only who waits is taken"
        self.answered_ns = self._begin_inference("invoke")
        return work

    def give(self, work: Work, rows: NDArray[np.float32] | ValueError) -> None:
        """Publishes the rows of ``work``, or why there are none."""
        self._end_inference()
        if isinstance(rows, ValueError):
            self._refuse(work, rows)
        else:
            self._answer(work, rows, self.answered_ns)

    def _infer_p99_ns(self) -> int:
        """In company: what this robot may have to wait with all that are admitted."""
        return self._admission.worst_with(self._link.robot)

    def _open(self, request: m.OpenRequest) -> m.Contract:
        self._admission.admit(self._link.robot, request.info.schedule)
        return super()._open(request)

    def _close(self) -> None:
        self.waiting = None
        self._admission.release(self._link.robot)
        super()._close()


class PounceFleet:
    """A ``ModelServer`` for several robots on one bus."""

    def __init__(
        self,
        link: Link,
        engine: BatchingEngine,
        heartbeat: Heartbeat,
        version: str,
        *,
        other_robots: Sequence[str],
        max_batch_rows: int,
    ) -> None:
        """``link`` and ``heartbeat`` are the first robot's."""
        self._engine = engine
        self._version = version
        self._max_rows = max_batch_rows
        self._ends = Ends(link, heartbeat, version, other_robots)
        self._servers: list[RobotServer] = []

    @property
    def shells(self) -> tuple[RobotServer, ...]:
        return tuple(self._servers)

    def warm_up(self) -> None:
        self._ends.warming()
        durations_ns = self._engine.warm_up()
        admission = Admission(batch_ns=self._batch_ns())
        for link, heartbeat in self._ends:
            self._servers.append(RobotServer(link, self._engine, heartbeat, self._version, admission))
        for server in self._servers:
            server.warmed(durations_ns)

    def ready(self) -> None:
        for server in self._servers:
            server.ready()

    def step(self) -> bool:
        """Reads every robot's messages, then answers those who have waited longest, in one batch."""
        worked = [server.step() for server in self._servers]
        waiting = sorted(
            (each for each in self._servers if each.waiting is not None), key=lambda each: each.answered_ns
        )
        if batch := [(server, server.take()) for server in waiting[: self._max_rows]]:
            for (server, work), rows in zip(batch, self._invoke([work for _, work in batch]), strict=True):
                server.give(work, rows)
        return any(worked) or bool(batch) or any([server.resume() for server in self._servers])

    def _invoke(self, batch: Sequence[Work]) -> list[NDArray[np.float32] | ValueError]:
        """The rows of each; if the batch is refused, one after the other, so that only the culprit has none."""
        try:
            return list(self._engine.invoke_many([work.request for work in batch], self._ends.beat))
        except ValueError as error:
            return [error] if len(batch) == 1 else [self._invoke([work])[0] for work in batch]

    def _batch_ns(self) -> dict[int, int]:
        """Times of batches of 1, 2, 4 and so on (p99), with prompts of different lengths as robots have them."""
        most = min(self._max_rows, len(self._ends))
        sizes = sorted({1 << power for power in range(most.bit_length()) if 1 << power < most} | {most})
        spec = self._engine.spec
        found = {}
        for size in sizes:
            examples = [example_request(spec, seed=seed) for seed in range(size)]
            requests = [replace(each, instruction=each.instruction[seed % 8 :]) for seed, each in enumerate(examples)]
            durations_ns = []
            for _ in range(1 + NUM_MEASURED_BATCHES):
                start_ns = time.perf_counter_ns()
                self._engine.invoke_many(requests, self._ends.beat)
                durations_ns.append(time.perf_counter_ns() - start_ns)
            found[size] = percentile_ns(durations_ns[1:], 99)
        return found
