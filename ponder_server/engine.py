"""The engine that runs Qwen3.5: sessions, one-pass fires, greedy text.

A fire appends observation *and carriers* in one forward and reads T_t at the last observation token. T_no, the
usual case, is then complete, because T_no is never part of the context (appendix A.2). On T_yes the context goes back
to the state that the forward kept after the observation, without the carriers; T_yes is appended, the text is decoded,
and the carriers follow. Without memory (`ContextFormat.remembers`) it goes back to the opening after each answer.

The engine is deterministic: on one machine equal calls give equal bits, also after reopening a session.

# K carriers, H hidden, T tokens, V vocabulary
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.gpu import settle
from dual_system.models.graphs import Capture, graphs_for
from dual_system.models.kernels.launch import cuda_time_ms, missing_for
from dual_system.models.ponder.checkpoint import weights_hash
from dual_system.models.ponder.context import SegmentKind
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.observation import Pictures, check_cameras
from ponder_server.batching import Batch
from ponder_server.context_policy import POLICIES, Span
from ponder_server.contract import (
    ContextFull,
    EngineSpec,
    Fire,
    Frame,
    Opening,
    Outcome,
    Progress,
    Proprio,
    SessionError,
    Text,
    no_progress,
)
from ponder_server.draft import Draft, NoDraft
from ponder_server.engine_config import EngineConfig
from ponder_server.episode import Episode, Query
from ponder_server.eyes import Eyes
from ponder_server.heartbeats import heartbeats
from ponder_server.narrow import check_change, check_weights, quantise
from ponder_server.opening import Opener
from ponder_server.runner import NUM_SAVED_STATES, Append, Runner, Session, fitted
from ponder_server.slots import slot_size
from ponder_server.threads import Threads
from ponder_server.writer import MAX_CHECKED_TOKENS, Steps, TransitionWriter

WARM_UP_SESSION = "warm-up"
WARM_UP_OPENING = Opening(instruction="warm up")
NUM_UNMEASURED_FIRES = 5
NUM_MEASURED_FIRES = 30
NUM_FULL_FIRES = 10
WARM_UP_PROPRIO = np.zeros(ROBOT_DIM, np.float32)

_ENCODED = object()


class QwenEngine:
    """A ``BatchingEngine`` on one device, one call at a time.

    One class, because a session's promise is kept across its methods: whatever ends a call early, contexts, queries on
    their way and slots are as they were.
    """

    def __init__(
        self, ponder: Ponder, config: EngineConfig, draft: Draft | None = None, *, capture: Capture | None = None
    ) -> None:
        """Takes over ``ponder``, and replaces its layers if ``config.weights`` is narrow.

        ``capture`` captures forwards; default: CUDA graphs on a GPU, none on a CPU.

        Raises ValueError if the sessions do not fit in memory, if the network cannot read the cameras, if its device
        does not support ``config.weights``, or if these change cognition too much.
        """
        check_weights(config.weights, ponder.device)
        self._ponder = ponder
        self._eyes = Eyes(ponder)
        self._config = config
        self._format = ponder.format
        self._episodes: dict[str, Episode] = {}
        reader = self._format.reader
        self._frame_px = reader.readable_sizes(ponder.image_px)[0]
        self._num_cameras = config.num_cameras or self._format.num_cameras
        check_cameras([self._frame_px] * self._num_cameras, reader, ponder.image_px)
        settle(ponder.device)
        ponder.served_hash = ponder.served_hash or weights_hash(ponder)
        size = slot_size(ponder.qwen.config.text_config, ponder.dtype)
        session_bytes = size.slot_bytes(config.max_context_tokens) + NUM_SAVED_STATES * size.state_bytes
        try:
            self._runner = Runner(
                ponder,
                num_slots=config.max_sessions,
                max_tokens=config.max_context_tokens,
                buckets=fitted(config.buckets, len(self._query_ids(WARM_UP_PROPRIO))),
                threads=Threads(config.attention_threads),
            )
        except (RuntimeError, MemoryError) as error:  # torch's own on a GPU and on a CPU
            raise ValueError(
                f"{config.max_sessions} sessions of {config.max_context_tokens} tokens need "
                f"{config.max_sessions * session_bytes / 2**20:,.0f} MiB beside the weights, more than {ponder.device} "
                "has. Lower max_sessions or max_context_tokens."
            ) from error
        self._spec = EngineSpec(
            num_carriers=self._format.num_carriers,
            hidden_size=ponder.hidden_size,
            image_px=ponder.image_px,
            num_cameras=self._num_cameras,
            cameras=self._format.cameras,
            reader=reader,
            demonstrations=self._format.demonstrations,
            max_context_tokens=config.max_context_tokens,
            model_hash=ponder.served_hash,
            is_random=ponder.is_random,
            dtype=str(ponder.dtype).removeprefix("torch."),
            session_bytes=session_bytes,
            gives_text=self._format.speaks,
            remembers=self._format.remembers,
        )
        draft = draft or NoDraft()
        self._parts = [*(layer.mlp for layer in ponder.layers), *draft.parts]
        self._writer = TransitionWriter(ponder, draft, max_text_tokens=config.max_text_tokens)
        self._num_query_ids = len(self._query_ids(WARM_UP_PROPRIO))
        self._opener = Opener(self._embed, max_prefixes=config.max_prefixes, chunk_tokens=config.prefill_chunk_tokens)
        self._begun: dict[str, Query] = {}
        self._batch: Batch[Fire] = Batch(self._runner, max_rows=config.max_batch_rows)
        if config.weights != "float":
            exact_KH = self._example_cognition()
            quantise(ponder, config.weights)
            change = float((self._example_cognition() - exact_KH).norm() / exact_KH.norm())
            check_change(config.weights, change, is_random=ponder.is_random)
            hash_ = f"{self._spec.model_hash}-{config.weights}"
            self._spec = replace(self._spec, weights=config.weights, model_hash=hash_, cognition_error=change)
        if capture is None and config.graphs:
            capture = graphs_for(ponder.device)
        if capture is not None:  # last, because captured graphs keep their weights
            has_kernels = config.kernels and ponder.device.type == "cuda" and not missing_for(ponder.device)
            timer = cuda_time_ms if has_kernels else None
            num_read = max(MAX_CHECKED_TOKENS, 1 + self._format.num_carriers)
            self._runner.capture(capture, num_read=num_read, timer=timer)
            self._eyes.capture(capture)
            draft.capture(capture)

    @property
    def spec(self) -> EngineSpec:
        return self._spec

    @torch.inference_mode()
    def open(
        self,
        session: str,
        opening: Opening,
        progress: Progress = no_progress,
        between: Callable[[], None] = no_progress,
    ) -> int:
        """Encodes instruction and demonstration; see ``BatchingEngine.open``."""
        if session in self._episodes:
            raise SessionError(f"session {session!r} is already open; close it first.")
        if len(self._episodes) >= self._config.max_sessions:
            raise SessionError(
                f"session {session!r} does not fit: {sorted(self._episodes)} are open and max_sessions is "
                f"{self._config.max_sessions}. Close one, or raise max_sessions."
            )
        if not opening.instruction.strip():
            raise ValueError(f"session {session!r}: the instruction is empty; PONDER needs the task's text")
        views = self._format.demonstrations.num_views
        demo_frames = opening.demo_frames if self._format.remembers else ()
        opening = replace(opening, demo_frames=tuple(cameras[:views] for cameras in demo_frames))
        for instant, cameras in enumerate(opening.demo_frames):
            if not cameras:
                raise ValueError(f"demo instant {instant} has no view")
        segments = self._format.opening(opening.instruction, [len(cameras) for cameras in opening.demo_frames])
        wanted = sum(len(segment) for segment in segments)
        if wanted > self._config.max_context_tokens:
            raise ContextFull(session=session, used=0, wanted=wanted, limit=self._config.max_context_tokens)
        demo = [self._see(cameras, f"demo instant {n}") for n, cameras in enumerate(opening.demo_frames)]
        context = self._runner.open(session)
        try:
            pictures = [picture for instant in demo for picture in instant]
            encoding = self._opener.encode(context, opening, segments, pictures)
            while True:
                with heartbeats(self._parts, progress):
                    if next(encoding, _ENCODED) is _ENCODED:
                        break
                progress()
                between()
        except BaseException as error:
            self._runner.close(context)
            if isinstance(error, torch.OutOfMemoryError):
                raise SessionError(f"session {session!r}: the device has no memory left to encode it.") from error
            raise
        self._episodes[session] = Episode(
            context=context,
            spans=[Span(segment.kind, len(segment)) for segment in segments],
            owes_reasoning=opening.has_demo,
        )
        return context.num_tokens

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
        force_text_tokens: int | None = None,
    ) -> Fire:
        """Runs one query alone; see ``PonderEngine.fire``.

        ``force_text_tokens`` forces a transition with a subgoal of exactly this many tokens, for benchmarks (the
        paper's 45-token workload, appendix D).
        """
        if self._begun or self._batch:
            busy = (*self._begun, *self._batch.sessions)
            raise SessionError(f"queries of {busy} are being thought about; step until they are done.")
        self.begin(session, frames, proprio=proprio, force_text_tokens=force_text_tokens)
        while True:
            for outcome in self.step(progress):
                return outcome.unwrap()

    def begin(
        self,
        session: str,
        frames: tuple[Frame, ...],
        *,
        proprio: Proprio | None = None,
        force_text_tokens: int | None = None,
    ) -> None:
        """Accepts one query, which :meth:`step` answers; see ``BatchingEngine.begin``."""
        episode = self._episode(session)
        context = episode.context
        if session in (*self._begun, *self._batch.sessions):
            raise SessionError(f"session {session!r} is thinking about a query already; one at a time.")
        if len(frames) != self._num_cameras:
            raise ValueError(f"fire got {len(frames)} frames, this engine has num_cameras {self._num_cameras}")
        pictures = self._see(frames, "observation")
        ids = self._query_ids(proprio)
        if force_text_tokens is not None and force_text_tokens < 1:
            raise ValueError(f"force_text_tokens is {force_text_tokens}; at least 1, or None")
        if self._format.remembers:
            self._make_room(episode)
        context.check_room(len(ids))
        self._begun[session] = Query(
            episode=episode,
            pictures=pictures,
            ids=ids,
            force_text_tokens=force_text_tokens,
            turn=self._batch.turn(),
        )

    def drop(self, session: str) -> None:
        """Cancels a session's unanswered query, if any."""
        self._begun.pop(session, None)
        self._batch.drop(session)

    @torch.inference_mode()
    def step(self, progress: Progress = no_progress) -> list[Outcome[Fire]]:
        """Runs one forward; returns the queries that it answered. See ``BatchingEngine.step``."""
        with heartbeats(self._parts, progress):
            # At most as many as share a forward: more would lengthen the vision tower's pass and exceed CPU caches.
            begun = {session: self._begun.pop(session) for session in [*self._begun][: self._config.max_batch_rows]}
            if begun:
                pictures = [picture for query in begun.values() for picture in query.pictures]
                embeds_TH = self._embed([token for query in begun.values() for token in query.ids], pictures)
                pieces = embeds_TH.split(self._num_query_ids)
                for (session, query), query_TH in zip(begun.items(), pieces, strict=True):
                    self._batch.add(session, self._think(query, query_TH), query.turn)
            return self._batch.step(progress)

    def _think(self, query: Query, embeds_TH: Tensor) -> Steps[Fire]:
        """Runs one query through the network; if it ends early, or without memory, the context is restored."""
        episode, exactly = query.episode, query.force_text_tokens
        context = episode.context
        num_observed = len(query.ids) - self._format.num_carriers
        observation_TH, carriers_KH = embeds_TH[:num_observed], embeds_TH[num_observed:]
        before = context.save(context.before_fire)
        is_kept = False
        try:
            texts: tuple[Text, ...] = ()
            is_transition, gate_score = exactly is not None, None
            unread_ids, unread_TH = query.ids[:num_observed], observation_TH
            at_once = Append(
                session=context,
                ids=query.ids,
                embeds_TH=embeds_TH,
                num_wanted=1 + self._format.num_carriers,
                num_kept=num_observed if self._format.speaks else 0,
            )
            if not is_transition:
                hidden_NH = yield at_once
                if self._format.speaks:
                    is_transition, gate_score = self._writer.gate(hidden_NH[:1])
                hidden_KH = hidden_NH[1:]
                if is_transition:
                    context.restore(context.kept)
                    unread_ids, unread_TH = (), observation_TH[:0]
            if is_transition:
                texts = yield from self._writer.write(
                    context,
                    before,
                    unread_ids,
                    unread_TH,
                    with_reasoning=episode.owes_reasoning and exactly is None,
                    exactly=exactly,
                )
                if texts:
                    hidden_KH = yield Append(session=context, ids=self._format.carrier_ids, embeds_TH=carriers_KH)
                else:  # rolled back: the same forward as for a query without a transition, hence the same bits
                    context.restore(before)
                    hidden_KH = (yield at_once)[1:]
            answer = self._answer(context, hidden_KH, texts, gate_score)
            num_written = len(context.ids) - before.num_ids - len(query.ids)
            if self._format.remembers:
                episode.spans += [
                    Span(SegmentKind.OBSERVATION, num_observed),
                    Span(SegmentKind.TEXT, num_written),
                    Span(SegmentKind.CARRIERS, self._format.num_carriers),
                ]
                episode.owes_reasoning &= not texts
                is_kept = True
            return answer
        finally:
            if not is_kept:
                context.restore(before)

    @torch.inference_mode()
    def close(self, session: str) -> None:
        """Keeps the memory for the next session; see ``PonderEngine.close``."""
        episode = self._episode(session)
        self.drop(session)
        self._runner.close(episode.context)
        del self._episodes[session]

    @torch.inference_mode()
    def warm_up(self) -> list[int]:
        """Durations in ns of cognition-only fires in the same short context, including the copy to the host.

        First captures, if enabled, every forward that an episode may need, so that no robot waits for it. Raises
        RuntimeError if that fails or changes cognition.
        """
        longest = max(self._num_query_ids, MAX_CHECKED_TOKENS)
        if self._runner.prepare(longest, max_rows=self._config.max_batch_rows):
            self._runner.check(self._example_cognition)
            self._spec = replace(self._spec, kernels=self._runner.kernels)
        frames = self.example_frames()
        max_rows = min(self._config.max_batch_rows, self._config.max_sessions)
        self._eyes.prepare(len(self._see(frames, "warm-up")), max_rows=max_rows)
        self.open(WARM_UP_SESSION, WARM_UP_OPENING)
        try:
            context = self._episode(WARM_UP_SESSION).context
            opened = context.save()
            self.fire(WARM_UP_SESSION, frames, proprio=WARM_UP_PROPRIO, force_text_tokens=1)
            durations_ns = []
            for _ in range(NUM_UNMEASURED_FIRES + NUM_MEASURED_FIRES):
                context.restore(opened)
                start_ns = time.perf_counter_ns()
                self.fire(WARM_UP_SESSION, frames, proprio=WARM_UP_PROPRIO)
                durations_ns.append(time.perf_counter_ns() - start_ns)
        finally:
            self.close(WARM_UP_SESSION)
        return durations_ns[NUM_UNMEASURED_FIRES:]

    @torch.inference_mode()
    def warm_up_full(self) -> list[int]:
        """Durations in ns of queries, frames to cognition, in a context filled with meaningless tokens."""
        self.open(WARM_UP_SESSION, WARM_UP_OPENING)
        try:
            context = self._episode(WARM_UP_SESSION).context
            if self._format.remembers:  # otherwise no context is ever fuller than after one query
                context.fill(max(context.num_tokens, context.max_tokens - self._num_query_ids))
            filled = context.save()
            durations_ns = []
            for _ in range(1 + NUM_FULL_FIRES):
                context.restore(filled)
                start_ns = time.perf_counter_ns()
                self._example_query(context).cpu()
                durations_ns.append(time.perf_counter_ns() - start_ns)
        finally:
            self.close(WARM_UP_SESSION)
        return durations_ns[1:]

    def example_frames(self) -> tuple[Frame, ...]:
        """Noise frames for one query, for measurements."""
        noise = np.random.default_rng(0)
        shape = (*self._frame_px, 3)
        return tuple(noise.integers(0, 256, shape, dtype=np.uint8) for _ in range(self._num_cameras))

    @torch.inference_mode()
    def _example_cognition(self) -> Tensor:
        """C (K, H) after the warm-up's context and one observation, without text: always the same tokens."""
        self.open(WARM_UP_SESSION, WARM_UP_OPENING)
        try:
            return self._example_query(self._episode(WARM_UP_SESSION).context)
        finally:
            self.close(WARM_UP_SESSION)

    def _example_query(self, context: Session) -> Tensor:
        """C (K, H) of one observation; T_t is computed but taken as T_no."""
        ids = self._query_ids(WARM_UP_PROPRIO)
        embeds_TH = self._embed(ids, [*self._see(self.example_frames(), "warm-up")])
        context.save(context.before_fire)
        hidden_NH = context.append(ids, embeds_TH, num_wanted=1 + self._format.num_carriers)
        self._writer.gate(hidden_NH[:1])
        return hidden_NH[1:].float()

    def _episode(self, session: str) -> Episode:
        episode = self._episodes.get(session)
        if episode is None:
            raise SessionError(f"session {session!r} is not open; open are {sorted(self._episodes)}.")
        return episode

    def _query_ids(self, proprio: Proprio | None) -> tuple[int, ...]:
        """Tokens of O_t and the carriers, a fixed number."""
        observed = self._format.observation(self._num_cameras, proprio)
        return (*observed.ids, *self._format.carrier_ids)

    def _see(self, frames: tuple[Frame, ...], where: str) -> Pictures:
        try:
            return self._format.reader.images(frames, self._format.image_px)
        except ValueError as error:
            raise ValueError(f"{where}, {error}") from None

    def _embed(self, ids: Sequence[int], pictures: Sequence[Pictures]) -> Tensor:
        if not pictures:
            return self._ponder.embed(ids)
        return self._ponder.embed(ids, torch.from_numpy(np.stack(pictures)), self._eyes)

    @torch.inference_mode()
    def _make_room(self, episode: Episode) -> None:
        """Applies the context policy, early enough for a transition with texts of full length to fit."""
        context = episode.context
        num_wanted = self._num_query_ids + 2 * (1 + self._config.max_text_tokens)
        if num_wanted <= context.room:
            return
        stays = POLICIES[self._config.when_full](episode.spans, num_wanted - context.room)
        if all(stays):
            return
        ends = list(accumulate(span.num_tokens for span in episode.spans))
        assert ends[-1] == context.num_tokens, "spans and cache disagree"
        context.keep(
            [
                range(end - span.num_tokens, end)
                for span, end, stay in zip(episode.spans, ends, stays, strict=True)
                if stay
            ]
        )
        episode.spans = [span for span, stay in zip(episode.spans, stays, strict=True) if stay]

    def _answer(self, context: Session, hidden_KH: Tensor, texts: tuple[Text, ...], gate_score: float | None) -> Fire:
        # A copy, because a view would keep the hidden states of the whole observation alive.
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
            gate_score=gate_score,
        )
