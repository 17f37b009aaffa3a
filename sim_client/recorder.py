"""Records all messages on the bus through the log's writer thread.

It is a passive subscriber, so the file has the messages as transmitted, byte for byte.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Literal

from clock.report import ADMITTED_EVENT, LEVEL_EVENT
from protocol import disk
from protocol import messages as m
from protocol.link import Link, Received, Stream
from protocol.mcap_log import EpisodeLog
from protocol.topics import EVENT, HEALTH, INFO, OBSERVATION, PHASE, RESULT, STREAMS, Topic

log = logging.getLogger(__name__)

_RANK = {topic.name: rank for rank, topic in enumerate(STREAMS)}
KEEP = 512  # per topic, between two drains; drains come every tick
_OWED_S = 0.5
_LOOK_NS = 10_000_000


class Recorder:
    """Collects the ticks of the current episode and, if asked, writes its log."""

    def __init__(self, link: Link, pixels: Literal["jpeg", "exact"]) -> None:
        self._link = link
        self._pixels: Literal["jpeg", "exact"] = pixels
        self._streams: list[tuple[Topic[object], Stream[object]]] = [
            (topic, link.subscribe(topic, keep=8 if topic is OBSERVATION else KEEP))
            for topic in sorted(reversed(STREAMS), key=lambda topic: topic is EVENT)
            if topic is not INFO
        ]  # what follows from others comes first: whatever arrives between two drains, the log has its cause
        self._log: EpisodeLog | None = None
        self._unrecorded = ""
        self._superseded: dict[str, int] = {}
        self.ticks: list[m.Tick] = []
        self.stamps: list[m.Stamp] = []
        self.invocations: list[m.Invocation] = []
        self.last_error = ""
        """What the episode's last error says. The ladder's steps down are left out: an error leads to them."""
        self._answered: set[tuple[m.StampKind, int]] = set()

    def begin(self, info: m.EpisodeInfo, path: Path | None) -> None:
        """Starts an episode; without a path nothing is written, and on a full disk neither.

        Raises OSError if the log cannot be made for another reason.
        """
        self.ticks, self.stamps, self.invocations, self.last_error = [], [], [], ""
        self._answered.clear()
        self._log, self._unrecorded = None, ""
        self._superseded = {topic.name: stream.subscription.num_superseded for topic, stream in self._streams}
        waits = info.schedule.mode == m.Mode.LOCKSTEP  # there the world has time, and a log with gaps is no proof
        if path is not None:
            try:
                self._log = EpisodeLog(path, info, pixels=self._pixels, when_full="wait" if waits else "drop")
            except OSError as error:
                if error.errno not in disk.FULL:
                    raise
                self._unrecorded = f"log {path.name}: {error.strerror}: the episode is not recorded"
                log.error("%s", self._unrecorded)

    def step(self) -> None:
        """Takes what has come since the last call."""
        taken = [(topic, each) for topic, stream in self._streams for each in stream.receive()]
        taken.sort(key=lambda pair: pair[0] is not EVENT)  # events say who is admitted
        received = []
        for topic, each in taken:
            if self._is_of_log(topic, each.message.header):  # type: ignore[attr-defined]
                self._admit(each.message)
                received.append((topic, each))
        received.sort(key=lambda pair: (_episode_ns(pair[1]), _RANK[pair[0].name]))  # within a topic it is stable
        for topic, (message, sample) in received:
            self._remember(message)
            if self._log is not None:
                self._log.write(topic, message, sample.payload, time.time_ns())

    def end(self, result: m.EpisodeResult) -> list[str]:
        """Writes the result and closes the log; returns descriptions of what is missing from it."""
        missing = [self._unrecorded] if self._unrecorded else []
        if self._log is not None:
            self._link.publish(RESULT, result, at_ns=max((t.decided_ns for t in self.ticks), default=0))
            self.step()
            self._await_answers()
            for topic, stream in self._streams:
                if lost := stream.subscription.num_superseded - self._superseded[topic.name]:
                    self._log.miss(topic, lost)
            closing = self._log.close(result)
            self._log = None
            if closing.error:
                missing.append(f"log {closing.path.name}: {closing.error}")
            if closing.dropped:
                missing.append(f"log {closing.path.name}: dropped {closing.dropped}")
        return missing

    def _await_answers(self) -> None:
        """A stamp may come before the answer that it admits, which another process sent on another link."""
        owed = {(stamp.kind, stamp.index) for stamp in self.stamps[-4:]}
        until_s = time.monotonic() + _OWED_S
        while not owed <= self._answered and time.monotonic() < until_s:
            self._link.bus.wait(_LOOK_NS)
            self.step()

    def _is_of_log(self, topic: Topic[object], header: m.Header) -> bool:
        """Whether a message belongs into this episode's log: nobody outside of it can write there."""
        if topic is HEALTH or topic is PHASE:  # of the process, not of the episode
            return self._link.members.get(header.proc) == header.boot_id
        is_ours = (header.episode, header.epoch) == (self._link.episode, self._link.epoch)
        return is_ours and self._link.is_member(header)

    def _admit(self, message: object) -> None:
        """Hears a restarted server from now on, if this is the clock service's word that it may take part."""
        if isinstance(message, m.Event) and message.name == ADMITTED_EVENT and message.header.proc == "clock":
            proc, boot_id = message.attributes["proc"], int(message.attributes["boot_id"])
            self._link.admit(m.Member(proc=proc, boot_id=boot_id))

    def _remember(self, message: object) -> None:
        if isinstance(message, m.Tick):
            self.ticks.append(message)
        elif isinstance(message, m.Stamp):
            self.stamps.append(message)
        elif isinstance(message, m.Invocation):
            self.invocations.append(message)
        elif isinstance(message, m.Event):
            if message.severity is m.Severity.ERROR and message.name != LEVEL_EVENT:
                self.last_error = message.text
        elif isinstance(message, m.Cognition) and message.header.proc == "ponder":
            self._answered.add((m.StampKind.COGNITION, message.query))
        elif isinstance(message, m.ActionChunk) and message.header.proc == "pounce":
            self._answered.add((m.StampKind.CHUNK, message.invocation))


def _episode_ns(received: Received[object]) -> int:
    header: m.Header = received.message.header  # type: ignore[attr-defined]
    return header.at_ns if header.clock_id == m.EPISODE_CLOCK else 0
