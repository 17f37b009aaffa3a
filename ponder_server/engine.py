"""The engine that thinks with a Qwen3.5: sessions, one-pass fires, greedy text.

A fire appends observation *and carriers* in one forward and reads T_t at the last observation token. T_no,
the usual case, is done then: T_no is never part of the context (appendix A.2), so the guess was the truth. On
T_yes the append is undone, the observation is appended again with T_yes behind it (its vision tokens are
kept), the text is decoded, and the carriers follow.

Nothing here depends on a clock or on chance: on one machine equal calls give equal bits, also after reopening
a session.

# K carriers, H hidden, T tokens, V vocabulary
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ponder_server.contract import (
    ContextFull,
    EngineSpec,
    Fire,
    Frame,
    Opening,
    Progress,
    SessionError,
    Text,
    no_progress,
)
from ponder_server.runner import BUCKETS, Runner, SavedState, Session
from ponder_server.writer import TransitionWriter
from ponderpounce.models.context import Segment
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_checkpoint import weights_hash

WARM_UP_SESSION = "warm-up"
NUM_UNMEASURED_FIRES = 5
NUM_MEASURED_FIRES = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineConfig:
    """How an engine serves; what it serves is in its ``Ponder``."""

    num_cameras: int = 2
    """Frames per fire, always the same cameras in the same order."""
    max_context_tokens: int = 16_384
    """Per session (paper, section 3.4: 16K holds 100 fires of two cameras and more)."""
    max_sessions: int = 4
    """Contexts held at once; all of them are allocated when the engine is built."""
    max_text_tokens: int = 256
    """Limit of one text. A text that reaches it is closed as it is and flagged ``truncated``."""
    prefill_chunk_tokens: int = 2048
    """Opening tokens per forward: more is faster, fewer lets ``progress`` be heard more often."""
    buckets: tuple[int, ...] = BUCKETS
    """Lengths that a forward's rows are padded to, growing."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if isinstance(value, int) and value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1.")
        if not self.buckets or self.buckets[0] < 1 or list(self.buckets) != sorted(set(self.buckets)):
            raise ValueError(f"buckets are {self.buckets}; they must be at least 1 and grow.")


@dataclass(slots=True, kw_only=True)
class _Episode:
    """A session in use, and the one thing about it that is not in its tokens."""

    context: Session
    before_fire: SavedState
    owes_reasoning: bool
    """A demonstration was shown and its reasoning (DR) not yet written; the first transition writes it."""


class QwenEngine:
    """A ``PonderEngine`` on one device, one call at a time."""

    def __init__(self, ponder: Ponder, config: EngineConfig) -> None:
        self._ponder = ponder
        self._config = config
        self._format = ponder.format
        self._episodes: dict[str, _Episode] = {}
        self._runner = Runner(
            ponder,
            num_slots=config.max_sessions,
            max_tokens=config.max_context_tokens,
            buckets=config.buckets,
        )
        self._spec = EngineSpec(
            num_carriers=self._format.num_carriers,
            hidden_size=ponder.hidden_size,
            image_px=ponder.image_px,
            num_cameras=config.num_cameras,
            max_context_tokens=config.max_context_tokens,
            model_hash=weights_hash(ponder),
            is_random=ponder.is_random,
            dtype=str(ponder.dtype).removeprefix("torch."),
        )
        self._writer = TransitionWriter(ponder, max_text_tokens=config.max_text_tokens)

    @property
    def spec(self) -> EngineSpec:
        return self._spec

    @torch.inference_mode()
    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        """Encodes instruction and demonstration; see ``PonderEngine.open``."""
        if session in self._episodes:
            raise SessionError(f"session {session!r} is already open; close it first.")
        if len(self._episodes) >= self._config.max_sessions:
            raise SessionError(
                f"session {session!r} does not fit: {sorted(self._episodes)} are open and max_sessions is "
                f"{self._config.max_sessions}. Close one, or raise max_sessions."
            )
        if not opening.instruction.strip():
            raise ValueError(f"session {session!r}: the instruction is empty; PONDER needs the task's text")
        for instant, views in enumerate(opening.demo_frames):
            if not views:
                raise ValueError(f"demo instant {instant} has no view")
            self._check_frames(views, f"demo instant {instant}")
        segments = self._format.opening(opening.instruction, [len(views) for views in opening.demo_frames])
        wanted = sum(len(segment) for segment in segments)
        if wanted > self._config.max_context_tokens:
            raise ContextFull(session=session, used=0, wanted=wanted, limit=self._config.max_context_tokens)
        context = self._runner.open(session)
        frames = [frame for views in opening.demo_frames for frame in views]
        try:
            for chunk in _chunks(segments, self._config.prefill_chunk_tokens):
                ids = [token for segment in chunk for token in segment.ids]
                num_images = sum(segment.num_images for segment in chunk)
                context.append(ids, self._embed(ids, frames[:num_images]), num_wanted=0)
                del frames[:num_images]
                progress()
        except BaseException:
            self._runner.close(context)
            raise
        self._episodes[session] = _Episode(context=context, before_fire=context.save(), owes_reasoning=opening.has_demo)
        return context.num_tokens

    @torch.inference_mode()
    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        force_text_tokens: int | None = None,
    ) -> Fire:
        """One query; see ``PonderEngine.fire``.

        ``force_text_tokens`` makes it a transition with a subgoal of exactly so many tokens, whatever the
        model wants to say (the paper's 45-token workload, appendix D). For benchmarks: the text is
        meaningless.
        """
        episode = self._episode(session)
        context = episode.context
        if len(frames) != self._config.num_cameras:
            raise ValueError(f"fire got {len(frames)} frames, this engine has num_cameras {self._config.num_cameras}")
        self._check_frames(frames, "observation")
        if force_text_tokens is not None and force_text_tokens < 1:
            raise ValueError(f"force_text_tokens is {force_text_tokens}; at least 1, or None")
        observation, carriers = self._format.observation(len(frames)), self._format.carriers()
        wanted = len(observation) + len(carriers)
        if wanted > context.room:
            raise ContextFull(session=session, used=context.num_tokens, wanted=wanted, limit=context.max_tokens)
        ids = [*observation.ids, *carriers.ids]
        embeds_TH = self._embed(ids, frames)
        before = context.save(episode.before_fire)
        try:
            if force_text_tokens is None:
                hidden_NH = context.append(ids, embeds_TH, num_wanted=1 + len(carriers))
                progress()
                if self._gate(hidden_NH[0]) != self._format.vocabulary.t_yes:
                    return self._answer(context, hidden_NH[1:], ())
                context.restore(before)
            texts = self._writer.write(
                context,
                before,
                observation.ids,
                embeds_TH[: len(observation)],
                with_reasoning=episode.owes_reasoning and force_text_tokens is None,
                exactly=force_text_tokens,
                progress=progress,
            )
            hidden_KH = context.append(carriers.ids, embeds_TH[len(observation) :])
            progress()
            answer = self._answer(context, hidden_KH, texts)
        except BaseException:
            context.restore(before)
            raise
        episode.owes_reasoning = False
        return answer

    def close(self, session: str) -> None:
        """Keeps the memory for the next session; see ``PonderEngine.close``."""
        self._runner.close(self._episode(session).context)
        del self._episodes[session]

    @torch.inference_mode()
    def warm_up(self) -> list[int]:
        """Durations in ns of cognition-only fires at one and the same short context, results on the host."""
        height, width = self._spec.image_px
        noise = np.random.default_rng(0)
        frames = tuple(
            noise.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(self._config.num_cameras)
        )
        self.open(WARM_UP_SESSION, Opening(instruction="warm up"))
        try:
            context = self._episode(WARM_UP_SESSION).context
            opened = context.save()
            self.fire(WARM_UP_SESSION, frames, force_text_tokens=1)
            durations_ns = []
            for _ in range(NUM_UNMEASURED_FIRES + NUM_MEASURED_FIRES):
                context.restore(opened)
                start_ns = time.perf_counter_ns()
                self.fire(WARM_UP_SESSION, frames)
                durations_ns.append(time.perf_counter_ns() - start_ns)
        finally:
            self.close(WARM_UP_SESSION)
        return durations_ns[NUM_UNMEASURED_FIRES:]

    def _episode(self, session: str) -> _Episode:
        episode = self._episodes.get(session)
        if episode is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._episodes)}.")
        return episode

    def _check_frames(self, frames: tuple[Frame, ...], where: str) -> None:
        expected = (*self._spec.image_px, 3)
        for index, frame in enumerate(frames):
            if frame.shape != expected or frame.dtype != np.uint8:
                raise ValueError(
                    f"{where}, frame {index}: {frame.dtype} of shape {frame.shape}; expected uint8 {expected}"
                )

    def _embed(self, ids: list[int], frames: tuple[Frame, ...] | list[Frame]) -> Tensor:
        if not frames:
            return self._ponder.embed(ids)
        return self._ponder.embed(ids, torch.from_numpy(np.stack(frames)).to(self._ponder.device))

    def _gate(self, hidden_H: Tensor) -> int:
        """The most likely next token, of all tokens: only exact T_yes is a transition."""
        return int(self._ponder.logits(hidden_H[None])[0].argmax())

    def _answer(self, context: Session, hidden_KH: Tensor, texts: tuple[Text, ...]) -> Fire:
        # a copy: a view would keep the hidden states of the whole observation alive
        cognition = hidden_KH.to("cpu", torch.float32, copy=True).numpy()
        if not np.isfinite(cognition).all():
            raise FloatingPointError(
                f"session {context.name!r}: cognition is not finite after {context.num_tokens} tokens; "
                f"weights {self._spec.model_hash} in {self._spec.dtype} are broken or overflow."
            )
        return Fire(
            cognition=cognition,
            is_transition=bool(texts),
            texts=texts,
            context_tokens=context.num_tokens,
        )


def _chunks(segments: tuple[Segment, ...], max_tokens: int) -> list[list[Segment]]:
    """Consecutive segments in groups of at most ``max_tokens``, or of one that is longer."""
    chunks: list[list[Segment]] = []
    num_tokens = 0
    for segment in segments:
        if not chunks or num_tokens + len(segment) > max_tokens:
            chunks.append([])
            num_tokens = 0
        chunks[-1].append(segment)
        num_tokens += len(segment)
    return chunks
