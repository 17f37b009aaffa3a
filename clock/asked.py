"""What one model was asked and has not been stamped yet: queries to PONDER, or invocations of POUNCE."""

from __future__ import annotations

from dataclasses import dataclass, field

from clock.commander import NO_ROW
from clock.delays import in_order
from protocol.messages import ActionChunk, Cognition, Floats, Stamp, StampKind


@dataclass(slots=True)
class Request:
    """A query or an invocation. ``delay_ns`` is known beforehand only if the delay is modelled."""

    index: int
    source_ns: int
    delay_ns: int | None
    terms: tuple[int, int | None, int] = (0, None, 0)
    """Tick of row 0, ref(j) and Delta(j) of an invocation, which its chunk must repeat."""
    state: Floats = field(default_factory=lambda: NO_ROW)
    """That of an invocation's observation, to which increments are added; its chunk must repeat it as well."""
    answer: Cognition | ActionChunk | None = None
    arrived_ns: int = 0

    @property
    def due_ns(self) -> int:
        """Lower bound of the instants that depend on the answer."""
        return self.source_ns + (self.delay_ns or 0)


@dataclass(slots=True)
class Asked:
    """Requests to one model, oldest first."""

    kind: StampKind
    is_lockstep: bool
    waiting: list[Request] = field(default_factory=list)
    _last_ready_ns: int | None = None

    def add(self, request: Request) -> None:
        self.waiting.append(request)

    def find(self, index: int, terms: tuple[int, int | None, int]) -> Request | None:
        return next((each for each in self.waiting if (each.index, each.terms) == (index, terms)), None)

    @property
    def owed(self) -> int | None:
        """The oldest request without an answer."""
        return next((each.index for each in self.waiting if each.answer is None), None)

    def is_owed_by(self, now_ns: int) -> bool:
        """Whether an answer is missing on which this instant depends."""
        return any(each.answer is None and each.due_ns <= now_ns for each in self.waiting)

    def is_busy(self, now_ns: int, overdue_ns: int) -> bool:
        """In real time a server gets one request at a time, so that the next one is about a fresh observation.

        An overdue answer (lost or refused) no longer blocks the next request, but is still taken if it comes.
        """
        return any(each.answer is None and now_ns - each.source_ns < overdue_ns for each in self.waiting)

    def forget_unanswered(self) -> None:
        """Waits no more for a server that is lost."""
        self.waiting[:] = [each for each in self.waiting if each.answer is not None]

    def take(self, index: int, answer: Cognition | ActionChunk, now_ns: int) -> bool:
        """Takes an answer; returns False if it was not asked for (late, duplicate, unknown)."""
        found = next((each for each in self.waiting if each.index == index and each.answer is None), None)
        if found is None or answer.source_ns != found.source_ns:
            return False
        found.answer, found.arrived_ns = answer, now_ns
        if found.delay_ns is None:  # measured: compute time (lockstep) or arrival (real time)
            found.delay_ns = answer.infer_ns if self.is_lockstep else now_ns - found.source_ns
        return True

    def ripe(self, now_ns: int) -> list[tuple[Request, Stamp]]:
        """Removes and stamps the answers that are ready at ``now_ns``, in the order of their requests.

        No answer is ready before an earlier one. In real time an answer that arrives after its modelled delay is ready
        on arrival, and later ones do not wait for an earlier one, which may never come. In lockstep time steps from
        tick to tick and then waits, so an answer's arrival in between must not matter.
        """
        ripe: list[tuple[Request, Stamp]] = []
        for head in list(self.waiting):
            if head.answer is None or head.delay_ns is None:
                if self.is_lockstep:
                    break
                continue
            came_ns = head.due_ns if self.is_lockstep else max(head.due_ns, head.arrived_ns)
            ready_ns = in_order(came_ns, self._last_ready_ns)
            if ready_ns > now_ns:
                break
            self._last_ready_ns = ready_ns
            self.waiting.remove(head)
            stamp = Stamp(
                kind=self.kind,
                index=head.index,
                source_ns=head.source_ns,
                ready_ns=ready_ns,
                arrived_ns=head.arrived_ns,
                is_transition=isinstance(head.answer, Cognition) and head.answer.is_transition,
            )
            ripe.append((head, stamp))
        return ripe
