"""A process's typed end of the bus: it adds headers to sent messages and validates received ones.

A message that does not decode, breaks a rule of ``checks``, names another robot, or whose header disagrees with its key
is counted, logged once per source and reason, and dropped. No peer's message can make ``Stream.drain`` raise. In an
episode only its members are heard: the processes, each with the id of its start, that the opening named.
"""

from __future__ import annotations

import dataclasses
import logging
import secrets
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any, Generic, NamedTuple, TypeVar

from protocol import codec, topics
from protocol.bus import Bus, Inbox, Sample, Subscription
from protocol.drops import DropReason
from protocol.errors import CallFailed, ProtocolError
from protocol.messages import EPISODE_CLOCK, Event, Header, Member, Severity
from protocol.process import host_clock_id
from protocol.topics import Call, Topic

T = TypeVar("T")

log = logging.getLogger(__name__)

_ATTACHMENT = struct.Struct("<QqQ")  # seq, source_ns, boot_id
_MAX_ALARMS = 16  # per episode: a flood of names must not fill its log


class Received(NamedTuple, Generic[T]):
    """A checked message and its bytes as received, which the log and the journal keep."""

    message: T
    sample: Sample


class Link:
    """A process's identity on a bus.

    ``enter_episode`` sets the episode of all messages published afterwards.

    Attributes:
        members: boot ids of the running episode's processes, by name. Others are not obeyed.
        second_sender: a sentence, once two processes send under one member's ids; "" until then.
        on_sent: is called with every message that was sent, by the thread that sent it.
    """

    def __init__(self, bus: Bus, *, robot: str, proc: str, boot_id: int | None = None) -> None:
        self.bus = bus
        self.robot = topics.checked_id(robot, "robot")
        self.proc = topics.checked_id(proc, "process")
        self.boot_id = boot_id if boot_id is not None else secrets.randbits(63)
        self.session = ""
        self.episode = ""
        self.epoch = 0
        self.members: dict[str, int] = {}
        self._boots: frozenset[int] = frozenset()  # those of the members; the transport's thread reads it
        self.second_sender = ""
        self._heard_ns: dict[str, int] = {}
        self._strangers: set[int] = set()
        self.dropped: Counter[DropReason] = Counter()
        self._seqs: Counter[str] = Counter()
        self._reported: set[tuple[str, str]] = set()
        self._streams: list[Stream[Any]] = []
        self.on_sent: Callable[[Any], None] | None = None

    def enter_episode(self, session: str, episode: str, epoch: int, members: Iterable[Member] = ()) -> None:
        """Sets the episode in the headers and keys of further messages, and who is in it besides this process.

        Raises:
            ProtocolError: an id cannot be part of a key.
        """
        self.session = topics.checked_id(session, "session")
        self.episode = topics.checked_id(episode, "episode")
        self.epoch = epoch
        self.members, self.second_sender = {}, ""
        self._heard_ns.clear()
        self._strangers.clear()
        self.admit(*members, Member(proc=self.proc, boot_id=self.boot_id))

    def admit(self, *members: Member) -> None:
        """Lets processes take part in the running episode, each in the place of the last one of its name."""
        self.members |= {member.proc: member.boot_id for member in members}
        self._boots = frozenset(self.members.values())

    def leave_episode(self) -> None:
        self.episode, self.epoch = "", 0
        self.members, self._boots = {}, frozenset()

    def header(self, topic: str, at_ns: int, clock_id: str = EPISODE_CLOCK) -> Header:
        seq = self._seqs[topic]
        self._seqs[topic] += 1
        return Header(
            robot=self.robot,
            session=self.session,
            episode=self.episode,
            epoch=self.epoch,
            proc=self.proc,
            boot_id=self.boot_id,
            seq=seq,
            clock_id=clock_id,
            at_ns=at_ns,
        )

    def publish(self, topic: Topic[T], message: T, *, at_ns: int, clock_id: str = EPISODE_CLOCK) -> T:
        """Adds the header, checks, encodes and sends; returns the message as sent.

        Raises:
            MalformedMessage: the message breaks the protocol, which is a bug of this process.
        """
        header = self.header(topic.name, at_ns, clock_id)
        signed = codec.brief(dataclasses.replace(message, header=header))  # type: ignore[type-var]
        payload = codec.encode(signed)
        source_ns = getattr(signed, "source_ns", at_ns)
        self.bus.publish(
            topics.stream_key(topic, self.robot, self.episode or "none", self.proc),
            payload,
            encoding=_encoding(topic.cls),  # type: ignore[arg-type]
            attachment=_ATTACHMENT.pack(signed.header.seq, source_ns, self.boot_id),  # type: ignore[attr-defined]
            priority=topic.priority,
        )
        if self.on_sent is not None:
            self.on_sent(signed)
        return signed  # type: ignore[no-any-return]

    def is_member(self, header: Header) -> bool:
        """Whether a message belongs to this episode and one of its members sent it; if not, it is counted."""
        return self.is_from(header, header.proc)

    def is_from(self, header: Header, proc: str) -> bool:
        """Whether a message belongs to this episode and its member ``proc`` sent it; if not, it is counted.

        A stranger's message is an alarm too, and nothing else.
        """
        if not self._is_of_episode(header):
            return False
        if header.proc == proc and self.members.get(proc) == header.boot_id:
            self._heard_ns[proc] = time.monotonic_ns()
            return True
        self._alarm(header, proc)
        return False

    def silent_ns(self, proc: str) -> int:
        """Time since the last message of a member (monotonic); since the machine started if there was none."""
        return time.monotonic_ns() - self._heard_ns.get(proc, 0)

    def _is_of_episode(self, header: Header) -> bool:
        if header.episode == self.episode and header.epoch == self.epoch:
            return True
        if not self.episode:  # between episodes: late messages of the last one are no fault
            self.dropped[DropReason.NO_EPISODE] += 1
            return False
        if header.session == self.session and header.epoch < self.epoch:  # the tail of an earlier one, nobody's fault
            self.dropped[DropReason.OTHER_EPISODE] += 1
            return False
        came = f"{header.episode} epoch {header.epoch}"
        self.drop(source_of(header), DropReason.OTHER_EPISODE, f"in {self.episode} epoch {self.epoch}, came {came}")
        return False

    def _alarm(self, header: Header, proc: str) -> None:
        """Counts a stranger's message; the first one per sender is an event of the episode."""
        text = f"{source_of(header)} is not the {proc} that this episode was opened with: it is not obeyed"
        self.drop(source_of(header), DropReason.STRANGER, text)
        if header.boot_id not in self._strangers and len(self._strangers) < _MAX_ALARMS:
            self._strangers.add(header.boot_id)
            event = Event(severity=Severity.ERROR, name=DropReason.STRANGER, text=f"{self.proc} heard that {text}")
            self.publish(topics.EVENT, event, at_ns=time.monotonic_ns(), clock_id=host_clock_id())

    def in_order(self, header: Header, last_seq: int) -> bool:
        """Whether a member's message is after its last one on the same topic; if not, it is counted.

        The bus keeps a sender's order, so two messages of one number are two senders: ``second_sender`` says so.
        """
        if header.seq > last_seq:
            return True
        came = f"message {header.seq} after message {last_seq}"
        self.drop(source_of(header), DropReason.SECOND_SENDER, came)
        self.second_sender = f"two processes send as {source_of(header)}: {came}"
        return False

    def subscribe(self, topic: Topic[T], *, keep: int | None = None, proc: str = "*") -> Stream[T]:
        """Subscribes to ``topic`` for this robot, in all episodes; the nodes filter by episode."""
        expression = topics.stream_key(topic, self.robot, "*", proc)
        subscription = self.bus.subscribe(expression, keep=keep or topic.keep, is_expected=self._is_expected)
        stream = Stream(self, topic, subscription)
        self._streams.append(stream)
        return stream

    def _is_expected(self, attachment: bytes) -> bool:
        return not self._boots or _boot_of(attachment) in self._boots

    def num_superseded(self) -> dict[str, int]:
        """Number of unread messages that newer ones pushed out, by topic."""
        counts: Counter[str] = Counter()
        for stream in tuple(self._streams):
            counts[stream.topic.name] += stream.subscription.num_superseded
        return dict(counts)

    def serve(self, call: Call) -> Service:
        return Service(self, call, self.bus.serve(topics.call_key(call, self.robot, self.proc)))

    def call(self, call: Call, proc: str, request: Any, *, timeout_ns: int) -> Any:
        """Calls ``proc`` and waits for the reply.

        Raises:
            CallFailed: no reply, or one that is not a ``call.reply``.
        """
        payload = self.bus.call(*self._request(call, proc, request), timeout_ns=timeout_ns)
        return self._reply(call, proc, payload, timeout_ns)

    def ask(self, call: Call, proc: str, request: Any, *, timeout_ns: int) -> Callable[[], Any]:
        """As ``call``, without waiting. The function returned gives the reply, or None while there is none.

        Raises:
            CallFailed: (the function) no reply, or one that is not a ``call.reply``.
        """
        future = self.bus.ask(*self._request(call, proc, request), timeout_ns=timeout_ns)
        return lambda: self._reply(call, proc, future.result(), timeout_ns) if future.done() else None

    def _request(self, call: Call, proc: str, request: Any) -> tuple[str, bytes]:
        if hasattr(request, "header"):
            request = dataclasses.replace(request, header=self.header(call.name, 0))
        return topics.call_key(call, self.robot, proc), codec.encode(request)

    def _reply(self, call: Call, proc: str, payload: bytes, timeout_ns: int) -> Any:
        try:
            return codec.decode(call.reply, payload)
        except ProtocolError as error:
            key = topics.call_key(call, self.robot, proc)
            raise CallFailed(key, timeout_ns / 1e6, f"unreadable answer: {error}") from None

    def drop(self, source: str, reason: DropReason, detail: str) -> None:
        """Counts a dropped message; the first one per source and reason is logged."""
        self.dropped[reason] += 1
        if (source, reason) not in self._reported and len(self._reported) < 1000:
            self._reported.add((source, reason))
            log.warning("dropped source=%s reason=%s detail=%r (later ones are only counted)", source, reason, detail)

    def survive(self, source: str, handler: Callable[..., T], *args: Any) -> T | None:
        """Returns ``handler(*args)``; None if it fails unexpectedly, which drops the message and ends no process.

        Raises:
            ProtocolError: the handler refuses the message.
        """
        try:
            return handler(*args)
        except ProtocolError:
            raise
        except Exception as error:  # whatever a message may lead to
            if (source, DropReason.FAILED) not in self._reported:
                log.exception("unexpected error in handling a message source=%s", source)
            self.drop(source, DropReason.FAILED, repr(error)[:500])
            return None


class Stream(Generic[T]):
    """Checked messages of one topic, oldest first."""

    def __init__(self, link: Link, topic: Topic[T], subscription: Subscription) -> None:
        self._link = link
        self.topic = topic
        self._encoding = _encoding(topic.cls)  # type: ignore[arg-type]
        self._last_seq: dict[int, int] = {}  # by boot id, of members
        self._num_turned_away = 0
        self.subscription = subscription

    def drain(self) -> list[T]:
        return [received.message for received in self.receive()]

    def receive(self) -> list[Received[T]]:
        """Like ``drain``, with each message's bytes as received."""
        accepted = []
        for sample in self.subscription.drain():
            message = self._accept(sample)
            if message is not None:
                accepted.append(Received(message, sample))
        if more := self.subscription.num_strange_superseded - self._num_turned_away:
            self._num_turned_away += more
            self._link.dropped[DropReason.STRANGER] += more
        return accepted

    def _accept(self, sample: Sample) -> T | None:
        if sample.encoding != self._encoding:
            self._link.drop(
                _source(sample), DropReason.WRONG_ENCODING, f"expected {self._encoding}, came {sample.encoding}"
            )
            return None
        try:
            message = codec.decode(self.topic.cls, sample.payload)
        except ProtocolError as error:
            self._link.drop(_source(sample), DropReason.MALFORMED, str(error))
            return None
        header: Header = message.header  # type: ignore[attr-defined]
        episode = topics.episode_of(sample.key)
        if header.robot != self._link.robot:
            self._link.drop(
                _source(sample), DropReason.WRONG_ROBOT, f"expected {self._link.robot}, came {header.robot}"
            )
            return None
        if episode and header.episode != episode:
            self._link.drop(
                _source(sample), DropReason.WRONG_EPISODE, f"key says {episode}, header says {header.episode}"
            )
            return None
        if episode and self._link.members.get(header.proc) == header.boot_id:
            if not self._link.in_order(header, self._last_seq.get(header.boot_id, -1)):
                return None
            self._last_seq[header.boot_id] = header.seq
        return message


@cache
def _encoding(cls: Any) -> str:
    return f"application/protobuf;{codec.type_name(cls)}"


def _source(sample: Sample) -> str:
    return f"{sample.key}#{_boot_of(sample.attachment)}"


def _boot_of(attachment: bytes) -> int:
    return _ATTACHMENT.unpack(attachment)[2] if len(attachment) == _ATTACHMENT.size else 0


class Service:
    """Calls of one kind that wait for this process."""

    def __init__(self, link: Link, call: Call, inbox: Inbox) -> None:
        self._link = link
        self._call = call
        self._inbox = inbox

    def answer(self, handler: Callable[[Any], Any]) -> int:
        """Answers every waiting call with ``handler(request)``; returns how many there were.

        If a request does not decode, or the handler raises, the reply's ``error`` is that message.
        """
        requests = self._inbox.drain()
        for request in requests:
            try:
                reply = handler(codec.decode(self._call.request, request.payload))
            except ProtocolError as error:
                self._link.drop(f"call {self._call.name}", DropReason.REFUSED_CALL, str(error))
                reply = self._call.reply(error=str(error))
            except Exception as error:  # whatever a request may lead to
                log.exception("unexpected error in call %s", self._call.name)
                self._link.drop(f"call {self._call.name}", DropReason.FAILED, repr(error)[:500])
                reply = self._call.reply(error=f"unexpected error, see the log: {error!r}"[:1000])
            request.reply(self._encoded(reply))
        return len(requests)

    def _encoded(self, reply: Any) -> bytes:
        try:
            return codec.encode(reply)
        except ProtocolError as error:
            log.exception("a reply to call %s breaks the protocol", self._call.name)
            self._link.drop(f"call {self._call.name}", DropReason.FAILED, str(error))
            return codec.encode(self._call.reply(error=f"unexpected error, see the log: {error}"))


def source_of(header: Header) -> str:
    """The sender of a message, for logs: a name that is none stays out of them."""
    return f"{header.proc if topics.is_id(header.proc) else '?'}#{header.boot_id}"
