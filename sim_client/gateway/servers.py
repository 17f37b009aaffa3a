"""What the model servers say of themselves, as the gateway's thread hears it and its network threads ask."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from clock.policies import servers_of
from protocol import messages as m
from protocol.drops import DropReason
from protocol.errors import TransportError
from protocol.link import Link
from protocol.topics import HEALTH, SHADOW_OF

log = logging.getLogger("pp-gateway")

_SILENCE_NS = 5_000_000_000


class Servers:
    """The newest heartbeats. ``unready`` and ``models`` may be asked by any thread, the rest by the working one."""

    def __init__(self, link: Link, policy: str) -> None:
        self._link = link
        self._procs = servers_of(policy)
        self._healths = link.subscribe(HEALTH)
        self._heard: dict[str, tuple[m.Health, int]] = {}  # by process: the newest, and when it came
        self._misshapen: dict[str, int] = {}  # by server: observations it had dropped for their shape at the start

    def hear(self) -> list[m.Health]:
        """Takes and returns what has come."""
        news, now_ns = self._healths.drain(), time.monotonic_ns()
        self._heard |= {health.header.proc: (health, now_ns) for health in news}
        return news

    def await_ready(self, patience_ns: int, turn: Callable[[], None], gives_up: Callable[[], str]) -> None:
        """Gives ``turn`` to the others until the servers are ready, and tells how far they are.

        Raises:
            TransportError: ``gives_up`` said why, or they are not ready within the patience.
        """
        states: dict[str, str] = {}
        deadline_ns = time.monotonic_ns() + patience_ns
        while any(states.get(proc) != "ready" for proc in self._procs):
            for health in self.hear():
                proc, is_ready = health.header.proc, health.state == m.ServingState.READY
                state = "ready" if is_ready else f"{health.state.name.lower()} ({health.progress:.0%})"
                if states.get(proc) != state:
                    log.info("robot=%s server=%s state=%s %s", self._link.robot, proc, state, health.detail)
                states[proc] = state
            if why := gives_up():
                raise TransportError(why)
            if time.monotonic_ns() > deadline_ns:
                missing = ", ".join(f"{proc} is {states.get(proc, 'not there')}" for proc in self._procs)
                raise TransportError(f"not ready within {patience_ns / 1e9:.0f} s (--patience-s): {missing}")
            turn()

    def unready(self) -> str:
        """Why no episode could begin: a sentence; "" if they say that they are ready."""
        now_ns, heard = time.monotonic_ns(), dict(self._heard)
        for proc in self._procs:
            health, heard_ns = heard.get(proc, (None, 0))
            if health is None or now_ns - heard_ns > _SILENCE_NS:
                return f"{proc} is not there"
            if health.state != m.ServingState.READY:
                return f"{proc} is {health.state.name.lower()} ({health.progress:.0%}) {health.detail}".strip()
        return ""

    @property
    def models(self) -> tuple[str, ...]:
        """The hashes of the models that were heard of last."""
        heard = dict(self._heard)
        return tuple(heard[proc][0].model_hash for proc in self._procs if proc in heard)

    def begin(self) -> None:
        """Remembers at an episode's start which observations were dropped before it."""
        for health in self.hear():
            self._misshapen[health.header.proc] = health.dropped.get(DropReason.WRONG_SHAPE, 0)

    def objection(self) -> str:
        """A sentence if an episode cannot go on: a server was built for other pictures or joints, or has a double."""
        if self._link.second_sender:
            return self._link.second_sender
        for health in self.hear():
            proc = health.header.proc
            if self._link.members.get(proc) != health.header.boot_id or proc in SHADOW_OF:
                continue
            if health.dropped.get(DropReason.WRONG_SHAPE, 0) > self._misshapen.get(proc, 0):
                return f"{proc} was built for other pictures, and says in its log for which. See --image-px"
        return ""
