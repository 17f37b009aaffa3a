"""A bus moves bytes between processes; ``LocalBus`` moves them within one, in order and without threads.

A ``Bus`` handles keys and bytes only; ``link`` adds types, identity and validation. There are no message callbacks: a
subscriber drains its subscription when it is ready, so no model ever runs on a transport's receive thread.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from operator import itemgetter
from typing import NamedTuple, Protocol

from protocol.errors import CallFailed
from protocol.topics import Priority, matches

ATTACHMENT_BYTES = 24  # seq u64, source_ns i64, boot_id u64, little-endian: shows drops and restarts without decoding


class Sample(NamedTuple):
    """One message as transmitted. The ``payload`` of a liveliness subscription is b"1" (appeared) or b"" (gone)."""

    key: str
    payload: bytes
    encoding: str
    attachment: bytes


def anybody(attachment: bytes) -> bool:
    """Expects every sample."""
    return True


class Subscription:
    """A ring of the newest ``keep`` samples (zenoh's RingChannel, with a bell): older ones are dropped and counted.

    Samples whose attachment ``is_expected`` refuses wait in a second ring, so that a stranger's flood pushes out
    nobody else's. One thread fills them, another drains them; operations on both ends of a deque with ``maxlen`` are
    atomic.
    """

    def __init__(self, keep: int, is_expected: Callable[[bytes], bool] = anybody) -> None:
        self._is_expected = is_expected
        self._expected, self._others = _Ring(keep), _Ring(keep)
        self._numbers = itertools.count()

    def put(self, sample: Callable[[], Sample], attachment: bytes = b"") -> None:
        """Stores a function that copies the sample out of the transport, so that dropped samples are never copied."""
        ring = self._expected if self._is_expected(attachment) else self._others
        ring.put((next(self._numbers), sample))

    def drain(self) -> list[Sample]:
        """Removes and returns all waiting samples, oldest first."""
        waiting = self._expected.drain()
        if others := self._others.drain():
            waiting = sorted([*waiting, *others], key=itemgetter(0))
        return [sample() for _, sample in waiting]

    @property
    def num_superseded(self) -> int:
        """Number of unread samples that newer ones pushed out."""
        return self._expected.num_superseded

    @property
    def num_strange_superseded(self) -> int:
        """As ``num_superseded``, of those that were not expected."""
        return self._others.num_superseded


class _Ring:
    """Numbered samples, of which the newest stay."""

    def __init__(self, keep: int) -> None:
        self._waiting: deque[tuple[int, Callable[[], Sample]]] = deque(maxlen=keep)
        self._num_received = self._num_drained = 0

    def put(self, sample: tuple[int, Callable[[], Sample]]) -> None:
        self._waiting.append(sample)
        self._num_received += 1

    def drain(self) -> list[tuple[int, Callable[[], Sample]]]:
        drained = []
        while self._waiting:
            try:
                drained.append(self._waiting.popleft())
            except IndexError:  # the other thread pushed the last one out meanwhile
                break
        self._num_drained += len(drained)
        return drained

    @property
    def num_superseded(self) -> int:
        return max(0, self._num_received - self._num_drained - len(self._waiting))


class Request(NamedTuple):
    """A call that waits for ``reply(bytes)``; without a reply the caller times out."""

    payload: bytes
    reply: Callable[[bytes], None]


class Inbox:
    """Requests in order of arrival, at most ``keep``; beyond that the oldest is dropped and its caller times out."""

    def __init__(self, keep: int = 32) -> None:
        self._requests: deque[Request] = deque(maxlen=keep)

    def put(self, request: Request) -> None:
        self._requests.append(request)

    def drain(self) -> list[Request]:
        requests = []
        while self._requests:
            requests.append(self._requests.popleft())
        return requests


class Bus(Protocol):
    """Interface of a transport."""

    is_local: bool
    """True if every peer shares this host, so that raw pixels are cheap to send."""

    def publish(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, priority: Priority) -> None: ...
    def subscribe(self, expression: str, *, keep: int, is_expected: Callable[[bytes], bool] = anybody) -> Subscription:
        """``is_expected`` is given attachments, by the transport's thread."""
        ...

    def serve(self, key: str) -> Inbox: ...
    def call(self, key: str, payload: bytes, *, timeout_ns: int) -> bytes:
        """Sends a request and returns the reply. Raises CallFailed if no reply comes in time."""
        ...

    def ask(self, key: str, payload: bytes, *, timeout_ns: int) -> Future[bytes]:
        """As ``call``, without waiting; the bell rings when it is done."""
        ...

    def declare_alive(self, key: str) -> None: ...
    def watch_alive(self, expression: str) -> Subscription: ...
    def wait(self, timeout_ns: int) -> None:
        """Returns when something may have arrived, or after ``timeout_ns``."""
        ...

    def ring(self) -> None:
        """Ends another thread's ``wait``: there is something to do that does not come over the bus."""
        ...

    def close(self) -> None: ...


class LocalBus:
    """All participants in one process and one thread: ``publish`` returns with a message in its subscribers' rings.

    A call runs the other participants' ``step`` functions until one replies; as over zenoh, a participant that waits
    for its own call is not stepped meanwhile. The in-process lockstep mode and the tests use it; nothing else differs
    from zenoh.
    """

    is_local = True

    def __init__(self) -> None:
        self._subscriptions: list[tuple[str, Subscription]] = []
        self._inboxes: dict[str, Inbox] = {}
        self._alive: list[str] = []
        self._watchers: list[tuple[str, Subscription]] = []
        self._participants: list[Callable[[], bool]] = []
        self._stepping: set[int] = set()

    def add_participant(self, step: Callable[[], bool]) -> None:
        """Adds a participant, whose ``step`` does one piece of pending work and returns whether there was any."""
        self._participants.append(step)

    def publish(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, priority: Priority) -> None:
        sample = Sample(key, payload, encoding, attachment)
        for expression, subscription in self._subscriptions:
            if matches(expression, key):
                subscription.put(lambda: sample, attachment)

    def subscribe(self, expression: str, *, keep: int, is_expected: Callable[[bytes], bool] = anybody) -> Subscription:
        subscription = Subscription(keep, is_expected)
        self._subscriptions.append((expression, subscription))
        return subscription

    def serve(self, key: str) -> Inbox:
        return self._inboxes.setdefault(key, Inbox())

    def call(self, key: str, payload: bytes, *, timeout_ns: int) -> bytes:
        inbox = self._inboxes.get(key)
        if inbox is None:
            raise CallFailed(key, timeout_ns / 1e6, "nobody serves it")
        answers: list[bytes] = []
        inbox.put(Request(payload, answers.append))
        while not answers:
            if not self.run_participants() and not answers:  # it may have answered inside of another one's call
                raise CallFailed(key, timeout_ns / 1e6, "its server has nothing to do and did not answer")
        return answers[0]

    def ask(self, key: str, payload: bytes, *, timeout_ns: int) -> Future[bytes]:
        future: Future[bytes] = Future()
        try:
            future.set_result(self.call(key, payload, timeout_ns=timeout_ns))
        except CallFailed as error:
            future.set_exception(error)
        return future

    def run_participants(self) -> bool:
        """Lets every participant do one piece of work; returns False if none had any."""
        return any([self._step(number) for number in range(len(self._participants))])  # a list: all get a turn

    def _step(self, number: int) -> bool:
        if number in self._stepping:
            return False
        self._stepping.add(number)
        try:
            return self._participants[number]()
        finally:
            self._stepping.discard(number)

    def declare_alive(self, key: str) -> None:
        self._alive.append(key)
        self._announce(key, b"1")

    def end_alive(self, key: str) -> None:
        """Simulates a dying process, for tests."""
        self._alive.remove(key)
        self._announce(key, b"")

    def _announce(self, key: str, payload: bytes) -> None:
        for expression, subscription in self._watchers:
            if matches(expression, key):
                subscription.put(lambda: Sample(key, payload, "", b""))

    def watch_alive(self, expression: str) -> Subscription:
        subscription = Subscription(64)
        self._watchers.append((expression, subscription))
        for key in self._alive:
            if matches(expression, key):
                subscription.put(lambda key=key: Sample(key, b"1", "", b""))  # type: ignore[misc]
        return subscription

    def wait(self, timeout_ns: int) -> None:
        self.run_participants()

    def ring(self) -> None:
        """Nobody waits here."""

    def close(self) -> None:
        self._subscriptions.clear()
        self._inboxes.clear()


class Bell:
    """Wakes one waiting thread when anything arrives on any subscription.

    It is a lock that is free while the bell is rung: one system call to ring, one to wait, where ``threading.Event``
    makes a new lock for every wait.
    """

    def __init__(self) -> None:
        self._silence = threading.Lock()
        self._silence.acquire()

    def ring(self) -> None:
        with contextlib.suppress(RuntimeError):  # rung already
            self._silence.release()

    def wait(self, timeout_ns: int) -> None:
        if timeout_ns > 0:
            self._silence.acquire(timeout=timeout_ns / 1e9)
        else:
            self._silence.acquire(blocking=False)
