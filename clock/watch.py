"""Liveness of servers: liveliness tokens show the process, heartbeats its work. Pure: messages and instants in."""

from __future__ import annotations

from dataclasses import dataclass, field

from protocol.messages import Health, ServingState

HEARTBEAT_TIMEOUT_NS = 700_000_000
TOKEN_GRACE_NS = 250_000_000
"""A lost token means a dead process only if its heartbeat stays away as well: anybody can declare and withdraw one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    proc: str
    is_lost: bool
    why: str


@dataclass(slots=True)
class _Seen:
    health: Health | None = None
    heard_ns: int = 0
    has_token: bool = True
    rival_ns: int | None = None  # when a second process of this name was heard
    is_lost: bool = False
    opened_ns: int | None = None  # when it answered an opening that none of its heartbeats has named yet


@dataclass(slots=True)
class Watch:
    """Detects within a second that a server died, froze or hangs, and that it is back *and in the episode*."""

    timeout_ns: int = HEARTBEAT_TIMEOUT_NS
    members: dict[str, int] = field(default_factory=dict)
    """Boot ids of the running episode's servers; heartbeats of others under their names say nothing."""
    _seen: dict[str, _Seen] = field(default_factory=dict)

    def on_health(self, health: Health, now_ns: int) -> None:
        if self.members.get(health.header.proc, health.header.boot_id) != health.header.boot_id:
            return
        seen = self._seen.setdefault(health.header.proc, _Seen())
        if seen.health is not None and seen.health.header.boot_id != health.header.boot_id:
            seen.rival_ns = now_ns
        seen.health, seen.heard_ns, seen.has_token = health, now_ns, True

    def on_token(self, proc: str, is_alive: bool) -> None:
        seen = self._seen.setdefault(proc, _Seen())
        seen.has_token = is_alive
        if not is_alive:
            seen.health = None  # a dead process's heartbeat says nothing about its successor

    def health_of(self, proc: str) -> Health | None:
        """The newest heartbeat of a present server; None if it is absent."""
        seen = self._seen.get(proc)
        return seen.health if seen and seen.has_token and not seen.is_lost else None

    def has_rival(self, proc: str, now_ns: int) -> bool:
        """Whether two processes of one name were heard in turn, outside of an episode."""
        seen = self._seen.get(proc)
        return seen is not None and seen.rival_ns is not None and now_ns - seen.rival_ns <= self.timeout_ns

    def is_lost(self, proc: str) -> bool:
        """Whether the last poll found trouble with ``proc``."""
        seen = self._seen.get(proc)
        return seen is not None and seen.is_lost

    def is_gone(self, proc: str) -> bool:
        """Whether ``proc`` had a liveliness token and lost it."""
        seen = self._seen.get(proc)
        return seen is not None and not seen.has_token

    def enter(self, members: dict[str, int], now_ns: int) -> None:
        """Begins an episode with servers that have just answered, or ends it (no members): losses are forgotten."""
        for seen in self._seen.values():
            seen.is_lost = False
        self.members = members
        for proc in members:  # what was heard before says nothing of this episode
            self._seen[proc] = _Seen(heard_ns=now_ns, opened_ns=now_ns)

    def poll(self, procs: tuple[str, ...], episode: str, now_ns: int) -> list[Change]:
        """Changes of ``procs``, which have all opened ``episode``, since the last poll."""
        changes = []
        for proc in procs:
            seen = self._seen.setdefault(proc, _Seen(heard_ns=now_ns))
            trouble = self._trouble(seen, episode, now_ns)
            if trouble and not seen.is_lost:
                changes.append(Change(proc=proc, is_lost=True, why=trouble))
            elif not trouble and seen.is_lost:
                changes.append(Change(proc=proc, is_lost=False, why="ready and in the episode"))
            seen.is_lost = bool(trouble)
        return changes

    def _trouble(self, seen: _Seen, episode: str, now_ns: int) -> str:
        silent_ns = now_ns - seen.heard_ns
        if not seen.has_token and silent_ns > TOKEN_GRACE_NS:
            return "its liveliness token is gone: the process died, is cut off, or does not run"
        if silent_ns > self.timeout_ns:
            return f"no heartbeat for {silent_ns / 1e6:.0f} ms: it is frozen, or its inference loop hangs"
        if seen.health is None:
            return "it was restarted and has not said anything yet" if seen.is_lost else ""
        if seen.health.state != ServingState.READY:
            return f"it is {seen.health.state.name.lower()} {seen.health.detail}".strip()
        if seen.health.open_episode == episode:
            seen.opened_ns = None
            return ""
        if seen.opened_ns is not None and not seen.is_lost and now_ns - seen.opened_ns <= self.timeout_ns:
            return ""  # the heartbeat is from before the opening, and was on its way
        return "it was restarted and does not know the episode yet"
