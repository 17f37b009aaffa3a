"""Selects the invocation that POUNCE answers, and builds the answer. Pure: messages in, work and messages out.

POUNCE is stateless: each invocation contains its cognition and names its observation, so a restarted POUNCE continues
as if it had never stopped. Only an engine with a window looks at the ticks before as well (`past`), and one with a
frame memory at the whole episode (`history`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from clock.playback import tick_at
from clock.timebase import NS_PER_S
from model_server.rendezvous import Rendezvous
from pounce_server.contract import EngineSpec, Request, Window
from pounce_server.history import History
from pounce_server.past import Past
from protocol import images
from protocol import messages as m
from protocol.errors import MalformedMessage

KEEP_INVOCATIONS = 1
"""Only the newest invocation is answered: an older one's chunk would be superseded before it is played."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """One chunk to generate."""

    invocation: m.Invocation
    request: Request
    num_missing: int = 0
    """Pictures of the past that the engine should read and that never came."""


class PounceNode:
    def __init__(self, spec: EngineSpec) -> None:
        self._spec = spec
        self._past: Past | None = None
        self._history: History | None = None
        self._rendezvous: Rendezvous[m.Invocation] = Rendezvous(keep_requests=KEEP_INVOCATIONS)
        self._info: m.EpisodeInfo | None = None
        self._next_asked = 0

    @property
    def num_superseded(self) -> int:
        return self._rendezvous.num_superseded

    def open(self, info: m.EpisodeInfo | None, demo: Sequence[m.DemoFrame] = ()) -> None:
        """Starts an episode, after its demonstration; None ends it.

        Raises:
            MalformedMessage: the engine has a frame memory, and the demonstration lacks a picture.
        """
        self._history = None if self._spec.past is None or info is None else History(self._spec.past, demo)
        self._rendezvous.clear()
        self._past = None if self._spec.window is None else Past(self._spec.window)
        self._info = info
        self._next_asked = 0

    def on_observation(self, observation: m.Observation) -> None:
        """Keeps an observation for invocations; without pictures it is ignored, as none names it (`will_look`).

        Raises:
            MalformedMessage: the engine cannot read its joints or cameras; the observation displaces no other.
        """
        num_cameras = self._spec.num_cameras
        is_blind = num_cameras > 0 and not observation.images
        if is_blind and self._past is None:
            return
        for field, expected in (("proprio", self._spec.proprio_dim), ("images", num_cameras)):
            came = len(getattr(observation, field))
            # An engine without cameras accepts any; a state without pictures is for windows.
            if came != expected and (field != "images" or (num_cameras and not is_blind)):
                raise MalformedMessage("Observation", field, f"{expected} of them", f"{came}")
        if self._past is not None:
            self._past.on_observation(observation)
        if self._history is not None:
            self._history.on_observation(observation)
        if not is_blind:
            self._rendezvous.on_observation(observation)

    def on_invocation(self, invocation: m.Invocation) -> None:
        """Keeps an invocation until its observation is there; one that was taken before is ignored."""
        if invocation.invocation >= self._next_asked:
            self._next_asked = invocation.invocation + 1
            self._rendezvous.on_request(invocation)

    def on_refusal(self, invocation: m.Invocation) -> None:
        """The engine gave no rows: where the clock waits for them, it may ask for the same ones again."""
        self._next_asked = min(self._next_asked, invocation.invocation)

    def missed(self) -> list[m.Invocation]:
        """Invocations whose observation was lost in transit."""
        return list(self._rendezvous.give_up())

    def next_work(self) -> Work | None:
        """The invocation whose observation is there.

        Raises:
            MalformedMessage: a frame is no picture, or the cognition is not (K, H); the invocation is then dropped.
        """
        pair = self._rendezvous.next_pair()
        if pair is None or self._info is None:
            return None
        invocation, observation = pair
        expected = (self._spec.num_carriers, self._spec.cognition_size)
        is_null = invocation.ref_query is None or self._spec.num_carriers == 0
        if not is_null and invocation.cognition.shape != expected:
            raise MalformedMessage("Invocation", "cognition", f"{expected}", f"{invocation.cognition.shape}")
        previous_rows = invocation.previous_rows
        if previous_rows.size % self._spec.action_dim:
            expected_size = f"rows of {self._spec.action_dim}"
            raise MalformedMessage("Invocation", "previous_rows", expected_size, f"{previous_rows.size} numbers")
        # The previous rows start at the invocation's tick, the new chunk's at its observation's.
        late_ticks = tick_at(observation.source_ns, invocation.now_ns, self._info.schedule.control_hz)
        request = Request(
            instruction=self._info.instruction,
            frames=tuple(images.unpack(image) for image in observation.images) if self._spec.num_cameras else (),
            proprio=observation.proprio,
            cognition=None if is_null else invocation.cognition,
            age_ns=0 if is_null else invocation.age_ns,
            seed=invocation.seed,
            previous_rows=previous_rows.reshape(-1, self._spec.action_dim) if previous_rows.size else None,
            previous_row0=max(0, late_ticks),
            committed_rows=invocation.committed_rows,
            subgoal=(invocation.text or "") if self._spec.reads_subgoal else "",
            window=None if self._past is None else self._past.window_at(observation.tick),
        )
        if self._history is None or self._info.schedule.delivery.kind == m.DeliveryKind.NULL:
            return Work(invocation=invocation, request=request)
        tick = observation.tick
        if invocation.ref_query is not None and self._history.is_delayed:
            before_ns = observation.source_ns - (invocation.now_ns - invocation.age_ns)
            tick = max(0, tick - round(before_ns * self._info.schedule.control_hz / NS_PER_S))
        remembered = replace(request, past=self._history.at(tick))
        num_missing = self._history.num_missing(tick)
        return Work(invocation=invocation, request=remembered, num_missing=num_missing)

    def answer(self, work: Work, rows_NA: m.Floats, *, infer_ns: int) -> m.ActionChunk:
        """The chunk message for rows (horizon, action_dim); row 0 belongs to the tick of its observation."""
        info, invocation = self._info, work.invocation
        rate_hz = info.schedule.control_hz if info is not None else 1
        horizon, action_dim = rows_NA.shape
        video, state = self._padded(work.request.window)
        return m.ActionChunk(
            invocation=invocation.invocation,
            t_row0=invocation.tick,
            horizon=horizon,
            action_dim=action_dim,
            dt_ns=1_000_000_000 // rate_hz,
            rows=np.ascontiguousarray(rows_NA, np.float32).ravel(),
            source_ns=invocation.now_ns,
            ref_query=invocation.ref_query,
            age_ns=invocation.age_ns,
            infer_ns=infer_ns,
            reference_state=work.request.proprio,
            seed=invocation.seed,
            model_hash=self._spec.model_hash,
            is_fake=self._spec.is_random or self._spec.has_fresh_prefix,
            previous_rows=invocation.previous_rows,
            committed_rows=invocation.committed_rows,
            padded_video_ticks=video,
            padded_state_ticks=state,
        )

    def _padded(self, window: Window | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The offsets at which a window has another tick's pictures, and another tick's state."""
        if window is None or self._spec.window is None:
            return (), ()
        offsets = self._spec.window
        video = tuple(compress(offsets.video_ticks, window.is_video_padded_T))
        return video, tuple(compress(offsets.state_ticks, window.is_state_padded_T))
