"""Several robots behind one door: every client has a seat of its own, or hears that none is free.

A seat is a `Machine` with a robot's name, a bus and a thread of its own; seats share nothing but the model servers.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future

from protocol.errors import TransportError
from sim_client.gateway.exchange import Answer, Busy, Finish, Step
from sim_client.gateway.machine import Machine

log = logging.getLogger("pp-gateway")


def seat_names(robot: str, count: int) -> tuple[str, ...]:
    """The robots' names of so many seats: ``robot``, ``robot-1``, ``robot-2`` and so on."""
    return (robot, *(f"{robot}-{index}" for index in range(1, count)))


class Seats:
    """Hands each client's requests to its seat. ``submit`` is for network threads, as a machine's.

    ``resets_inherit``: whether a reset over a new connection, if no seat is free, ends the episode of the same host's
    connection that has been silent for longest. The evaluator of RoboMME's policy repository opens one an episode and
    closes none. For lockstep alone: there the robot is simulated.
    """

    def __init__(self, machines: Sequence[Machine], *, resets_inherit: bool = False) -> None:
        self._machines = machines
        self._resets_inherit = resets_inherit
        self._lock = threading.Lock()  # of finding a seat and taking it

    def submit(self, client: str, request: Step | Finish) -> Future[Answer | None]:
        """Hands in a request; the future holds its answer (None of a Finish), or raises Refused.

        Raises:
            Busy: every seat is taken.
            Refused: the gateway was stopped.
        """
        with self._lock:
            theirs = [each for each in self._machines if each.holder == client]
            if isinstance(request, Finish) and not theirs and request.is_reset and self._resets_inherit:
                theirs = self._left_behind(client)
                client = theirs[0].holder if theirs else client
            if theirs or isinstance(request, Finish):
                return (theirs or self._machines)[0].submit(client, request)
            working = [each for each in self._machines if not each.is_closed] or self._machines
            for machine in sorted(working, key=lambda each: each.holder != ""):  # then who fell silent loses
                try:
                    return machine.submit(client, request)
                except Busy as error:
                    why = error
        if len(working) == 1:
            raise why
        raise Busy(
            f"all {len(working)} seats are taken, one of them by {working[-1].holder}. Wait until a client has "
            "finished or left, or start pp-gateway with more --seats, and its servers with as many robots."
        )

    def _left_behind(self, client: str) -> list[Machine]:
        """The seat that another connection of the client's host may have left behind; [] while a seat is free."""
        if not all(each.holder for each in self._machines):
            return []
        of_host = [each for each in self._machines if _host(each.holder) == _host(client)]
        return sorted(of_host, key=lambda each: each.heard_ns)[:1]

    def unready(self) -> str:
        """Why no seat could begin an episode; "" if one can, were it free."""
        return min((machine.unready() for machine in self._machines), key=len)

    @property
    def models(self) -> tuple[str, ...]:
        """The hashes of the models behind the seats, which share them."""
        return self._machines[0].models

    def await_servers(self, should_stop: Callable[[], bool]) -> None:
        """Waits until both model servers are ready for every seat. Raises TransportError as a machine does."""
        for machine in self._machines:
            machine.await_servers(should_stop)

    def run(self, should_stop: Callable[[], bool], is_draining: Callable[[], bool] = lambda: False) -> None:
        """Works as a machine does, each seat in a thread. One that fails leaves the others.

        Raises:
            TransportError: all have failed.
        """
        if len(self._machines) == 1:
            self._machines[0].run(should_stop, is_draining)
            return
        threads = [
            threading.Thread(target=_run, args=(machine, should_stop, is_draining), name=machine.robot, daemon=True)
            for machine in self._machines
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            while thread.is_alive():
                thread.join(0.2)  # in slices, so that a signal is handled
        if not (should_stop() or is_draining()):
            raise TransportError("every seat has failed; the log says why")


def _run(machine: Machine, should_stop: Callable[[], bool], is_draining: Callable[[], bool]) -> None:
    try:
        machine.run(should_stop, is_draining)
    except Exception:  # a bug: the others' robots are not to stop for it
        log.exception("seat=%s failed, and is closed", machine.robot)


def _host(client: str) -> str:
    """``client``: HOST:PORT."""
    return client.rpartition(":")[0]
