"""``ponder-serve --backend openai``: a chat model behind PONDER's contract. It gives text and no vectors.

Whatever goes wrong with a reply is no transition: the subgoal in force stays in force, and the answer says what it was.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Sequence

import numpy as np

from dual_system.models.ponder.observation import Pictures, Size, WholeViews, check_pictures
from ponder_server.chat.ask import Ask
from ponder_server.chat.client import ChatEndpoint, ChatError
from ponder_server.chat.rule import BrokenReply, History, body_of, reply_of
from ponder_server.contract import EngineSpec, Fire, Frame, Opening, Progress, Proprio, SessionError, Text, no_progress

log = logging.getLogger(__name__)

NUM_MEASURED = 3  # not 20: each costs a reply of an endpoint that may be paid for
_PROBE_PX = (64, 64)
_PROBE_S = 60.0
_ASK_AGAIN_S = 1.0
_NO_CARRIERS = np.zeros((0, 0), np.float32)


class AnyViews(WholeViews):
    """Any number of cameras of any size, of which each becomes a picture of the request."""

    def images(self, views: Sequence[Pictures], image_px: Size) -> Pictures:
        check_pictures(views)
        return np.stack(views)

    def unreadable(self, sizes: Sequence[Size], image_px: Size) -> tuple[int, str] | None:
        return None


class ChatPonder:
    """A ``PonderEngine``. It keeps an episode's pictures and subgoals; the endpoint keeps nothing."""

    def __init__(self, endpoint: ChatEndpoint, model: str, ask: Ask, *, answer_s: float, start_s: float) -> None:
        """Waits until the endpoint answers a request with a picture.

        Args:
            model: name at the endpoint.
            answer_s: longest time for a reply, in seconds; a later one is no transition.
            start_s: longest wait for the endpoint, in seconds: a model may still be loading.

        Raises:
            ValueError: it refuses the request, or does not answer within ``start_s``.
        """
        self._endpoint, self._model, self._ask, self._answer_s = endpoint, model, ask, answer_s
        self._sessions: dict[str, History] = {}
        identity = hashlib.sha256(f"{endpoint.url} {model} {ask.digest}".encode()).hexdigest()[:8]
        vocabulary = f"one of {len(ask.subgoals)} subgoals" if ask.subgoals else "any subgoal"
        self.spec = EngineSpec(
            num_carriers=0,
            hidden_size=0,
            image_px=_PROBE_PX,
            num_cameras=None,
            max_context_tokens=0,
            model_hash=f"chat-{model[:48]}@{endpoint.host[:48]}-{identity}",
            is_random=False,
            dtype="text",
            reader=AnyViews(),
            answers_newest=True,
            introduction=f"zero-shot planner {model} at {endpoint.url}, asked as in {ask.digest} for {vocabulary}",
        )
        self._await_endpoint(start_s)

    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        """See ``PonderEngine.open``. Nothing is asked yet."""
        if session in self._sessions:
            raise SessionError(f"session {session!r} is already open; close it first.")
        if not opening.instruction.strip():
            raise ValueError(f"session {session!r}: the instruction is empty; the planner needs the task's text")
        progress()
        self._sessions[session] = History.of(self._ask, opening)
        return 0

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """See ``PonderEngine.fire``; it returns within ``answer_s``, and without a usable reply has ``trouble``."""
        history = self._sessions.get(session)
        if history is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._sessions)}.")
        check_pictures(frames)
        history.see(frames)
        subgoal, tokens, trouble = "", 0, ""
        try:
            answer = self._endpoint.post(body_of(self._model, history), self._answer_s, progress)
            subgoal, tokens = reply_of(answer, self._ask)
        except (ChatError, BrokenReply) as error:
            trouble = str(error)
        is_transition = history.take(subgoal)
        text = Text(kind="subgoal", text=subgoal, token_ids=(), truncated=False)
        return Fire(
            cognition=_NO_CARRIERS,
            is_transition=is_transition,
            texts=(text,) if is_transition else (),
            context_tokens=tokens,
            trouble=trouble,
        )

    def close(self, session: str) -> None:
        """See ``PonderEngine.close``."""
        if self._sessions.pop(session, None) is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._sessions)}.")

    def warm_up(self) -> list[int]:
        """Durations in ns of a few replies to a request with one black picture; one that fails counts as it lasted."""
        durations_ns = []
        for _ in range(NUM_MEASURED):
            start_ns = time.perf_counter_ns()
            try:
                reply_of(self._endpoint.post(self._probe(), self._answer_s), self._ask)
            except (ChatError, BrokenReply) as error:
                log.warning("planner model=%s %s", self._model, error)
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns

    def _probe(self) -> bytes:
        history = History.of(self._ask, Opening(instruction="Warm up: there is nothing to do."))
        history.see((np.zeros((*_PROBE_PX, 3), np.uint8),))
        return body_of(self._model, history)

    def _await_endpoint(self, start_s: float) -> None:
        deadline_s = time.monotonic() + start_s
        while True:
            try:
                self._endpoint.post(self._probe(), min(_PROBE_S, start_s))
            except ChatError as error:
                if error.is_final or time.monotonic() + _ASK_AGAIN_S > deadline_s:
                    raise ValueError(f"{error}. Is --url an OpenAI endpoint, and does --model see pictures?") from None
                log.info("planner waits for %s: %s", self._endpoint.url, error)
                time.sleep(_ASK_AGAIN_S)
            else:
                return
