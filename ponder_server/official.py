"""``ponder-serve --backend official``: the official System 2 behind PONDER's contract.

Their server builds the session, its context object answers every query. Only *when* it is asked is ours.
"""

# K carriers, H hidden, h w height and width of a frame

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.official.their_server import TheirServer, weights_hash
from dual_system.models.ponder.demo_sampling import DemoSampling
from ponder_server.contract import (
    ContextFull,
    EngineSpec,
    Fire,
    Frame,
    Opening,
    Progress,
    Proprio,
    SessionError,
    Text,
    no_progress,
)

IMAGE_PX = (256, 256)
WARM_UP_SESSION = "warm-up"
NUM_UNMEASURED, NUM_MEASURED = 3, 20
_NO_STATE = np.zeros(ROBOT_DIM, np.float32)


@dataclass(slots=True)
class _Session:
    instruction: str
    is_open: bool = False
    """Task and demonstration are encoded; from then on their context fires."""
    answer: Any = None
    """Their newest S2ContextResult."""
    failure: str = ""
    """Their last error; nothing public says what a context is worth after one, so the session answers no more."""


class OfficialPonder:
    """A ``PonderEngine``. Several sessions may be open; their contexts live on the one device."""

    def __init__(self, folder: Path, device: str) -> None:
        """Loads the official checkpoint. Raises OfficialError without the official package."""
        self._theirs = TheirServer(folder, device)
        self._theirs.show_every_demo_frame()
        server = self._theirs.server
        server._s2_period_ns = server._dt_ns  # an observation is a query: the clock decides which are sent
        server._fire_s1 = lambda episode, observation, now: None
        server._dispense = lambda episode, observation: {}
        self._fire = server._fire_s2
        server._fire_s2 = self._on_query
        self._sessions: dict[str, _Session] = {}
        self._now = ""
        self.spec = EngineSpec(
            num_carriers=self._theirs.num_carriers,
            hidden_size=self._theirs.hidden_size,
            image_px=IMAGE_PX,
            num_cameras=self._theirs.num_cameras,
            max_context_tokens=int(server._s2.effective_context_cap),
            model_hash=weights_hash(folder),
            is_random=False,
            dtype=str(server._dtype).removeprefix("torch."),
            demonstrations=DemoSampling(hz=1, num_views=1),
        )

    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        """See ``PonderEngine.open``. Task and demonstration are encoded here, not at the first query as theirs are."""
        if session in self._sessions:
            raise SessionError(f"session {session!r} is already open; close it first.")
        if not opening.instruction.strip():
            raise ValueError(f"session {session!r}: the instruction is empty; PONDER needs the task's text")
        progress()
        self._sessions[session] = _Session(opening.instruction)
        self._theirs.start(session)
        black = [np.zeros((*IMAGE_PX, 3), np.uint8)] * self._theirs.num_cameras  # makes the session; never encoded
        demo = [views[0] for views in opening.demo_frames]
        try:
            self._observe(session, black, _NO_STATE, demo)
        except BaseException:
            self.close(session)
            raise
        progress()
        return self._num_tokens(session)

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """See ``PonderEngine.fire``, but not atomic: after an error of theirs the session answers no more."""
        state = self._session(session)
        if state.failure:
            raise SessionError(f"session {session!r} ended with their error: {state.failure}")
        if len(frames) != self.spec.num_cameras:
            raise ValueError(f"fire got {len(frames)} frames, the official server has {self.spec.num_cameras} cameras")
        progress()
        state.answer = None
        try:
            self._observe(session, list(frames), _NO_STATE if proprio is None else proprio)
        except RuntimeError as error:
            state.failure = str(error)
            used, limit = self._num_tokens(session), self.spec.max_context_tokens
            if "exceeds cap" not in state.failure:
                raise SessionError(f"session {session!r}: {error}") from error
            raise ContextFull(session=session, used=used, wanted=1, limit=limit) from error
        progress()
        answer = state.answer
        if answer is None:
            raise SessionError(f"session {session!r}: their server did not fire System 2; is it another commit?")
        cognition_KH = answer.cognition.detach().float().cpu().numpy()
        return Fire(
            cognition=cognition_KH.reshape(self.spec.num_carriers, self.spec.hidden_size).astype(np.float32),
            is_transition=answer.kind == "transition",
            texts=_texts(answer),
            context_tokens=self._num_tokens(session),
            gate_score=None if answer.gate_score is None else float(answer.gate_score),
        )

    def close(self, session: str) -> None:
        """See ``PonderEngine.close``."""
        self._session(session)
        del self._sessions[session]
        self._theirs.end(session)

    def warm_up(self) -> list[int]:
        """See ``PonderEngine.warm_up``."""
        frames = tuple(np.zeros((*IMAGE_PX, 3), np.uint8) for _ in range(self._theirs.num_cameras))
        durations_ns = []
        self.open(WARM_UP_SESSION, Opening(instruction="warm up"))
        try:
            for _ in range(NUM_UNMEASURED + NUM_MEASURED):
                start_ns = time.perf_counter_ns()
                self.fire(WARM_UP_SESSION, frames)
                durations_ns.append(time.perf_counter_ns() - start_ns)
        finally:
            self.close(WARM_UP_SESSION)
        return durations_ns[NUM_UNMEASURED:]

    def _observe(self, session: str, frames: list[Frame], state: Proprio, demo: list[Frame] | None = None) -> None:
        self._now = session
        self._theirs.observe(session, self._sessions[session].instruction, frames, state, demo or ())

    def _on_query(self, episode: Any, observation: Any, now: int) -> None:
        """Called by their server when System 2 is due. It builds the context at the first call and fires at each."""
        state = self._sessions[self._now]

        def fired(fire: Callable[..., Any], *given: Any, **named: Any) -> Any:
            state.answer = fire(*given, **named) if state.is_open else self._theirs.no_answer()
            return state.answer

        with self._theirs.contexts_fire_through(fired):
            self._fire(episode, observation, now)
        state.is_open = True

    def _num_tokens(self, session: str) -> int:
        context = self._theirs.server._episodes[session].s2_context
        return int(getattr(context, "_context_len", 0))

    def _session(self, session: str) -> _Session:
        state = self._sessions.get(session)
        if state is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._sessions)}.")
        return state


def _texts(answer: Any) -> tuple[Text, ...]:
    """Reasoning and subgoal of a transition; their result has the tokens of the subgoal only."""
    if answer.kind != "transition":
        return ()
    tokens = () if answer.subgoal_tokens is None else tuple(int(token) for token in answer.subgoal_tokens)
    subgoal = Text(kind="subgoal", text=answer.subgoal_text or "", token_ids=tokens, truncated=False)
    reasoning = getattr(answer, "reasoning_text", None)
    if not reasoning:
        return (subgoal,)
    return Text(kind="demo_reasoning", text=reasoning, token_ids=(), truncated=False), subgoal
