"""Pairs requests with their observations; whichever arrives first waits for the other.

Observations and requests have different bus priorities, so either may arrive first. Pure; both servers' nodes use it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from protocol.messages import Observation


class NamesTick(Protocol):
    @property
    def tick(self) -> int: ...


R = TypeVar("R", bound=NamesTick)

KEEP_OBSERVATIONS = 8


class Rendezvous(Generic[R]):
    """Pairs requests, in order, with the observation of their tick."""

    def __init__(self, *, keep_requests: int) -> None:
        self._observations: OrderedDict[int, Observation] = OrderedDict()
        self._requests: list[R] = []
        self.keep_requests = keep_requests
        self.num_superseded = 0

    def on_observation(self, observation: Observation) -> None:
        self._observations[observation.tick] = observation
        while len(self._observations) > KEEP_OBSERVATIONS:
            self._observations.popitem(last=False)

    def on_request(self, request: R) -> None:
        self._requests.append(request)
        while len(self._requests) > self.keep_requests:
            self._requests.pop(0)
            self.num_superseded += 1

    def next_pair(self) -> tuple[R, Observation] | None:
        """The oldest request whose observation is there, and that observation."""
        for position, request in enumerate(self._requests):
            observation = self._observations.get(request.tick)
            if observation is not None:
                del self._requests[position]
                return request, observation
        return None

    def give_up(self) -> Iterator[R]:
        """Removes requests whose observation can no longer arrive, because a newer one did and the ring moved past."""
        oldest = next(iter(self._observations), None)
        for request in list(self._requests):
            if oldest is not None and request.tick < oldest:
                self._requests.remove(request)
                yield request

    def clear(self) -> None:
        self._observations.clear()
        self._requests.clear()
