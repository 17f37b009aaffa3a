"""Collates examples into the joint model's batch; POUNCE's inputs come from the code that ``pounce-serve`` uses."""

# I invocations of all examples, N horizon, A padded action dim

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from clock.sampling import SampledInvocation
from dual_system.models.frame_sampling import FrameSampling, PastFrame
from dual_system.models.groot.pounce import GrootInputs, GrootPounceConfig
from dual_system.models.groot.prompt import EagleTokenizer
from dual_system.models.normalisation import Floats, RobotStatistics
from dual_system.models.pi05.modulation import NO_FRAME
from dual_system.models.pi05.pounce import PounceConfig, PounceInputs
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.pounce.batching import joined_groot, joined_pi05
from dual_system.models.pounce.checkpoint import AnyTokenizer
from dual_system.models.pounce.family import AnyPounceConfig, sampling_of
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from dual_system.training.chunks import chunk_ticks
from dual_system.training.episode import Frame
from dual_system.training.example import Example
from dual_system.training.joint import NO_QUERY, PonderBatch, PounceBatch

_GROOT_PAD = "<|endoftext|>"
_CPU = torch.device("cpu")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _TrainingMoment:
    """One invocation as a `pounce.reading.Moment`, without cognition: the model adds that from the autograd graph."""

    index: int
    """Index of the example in the batch."""
    example: Example
    place: int
    """The invocation's, among the example's."""
    sampling: FrameSampling | None
    """The sampling of POUNCE's frame memory; None without one."""

    @property
    def invocation(self) -> SampledInvocation:
        return self.example.invocations[self.place]

    @property
    def instruction(self) -> str:
        return self.example.episode.instruction

    @property
    def views(self) -> tuple[Frame, ...]:
        return self.example.episode.views[self.invocation.tick]

    @property
    def is_embedded(self) -> bool:
        """Whether the views are what a frozen tower makes of them (`frozen_towers`)."""
        return any(view.dtype == np.float16 for view in self.views)

    @property
    def frames(self) -> Sequence[NDArray[np.uint8] | None]:
        return [None if self.is_embedded else view.astype(np.uint8, copy=False) for view in self.views]

    @property
    def proprio(self) -> Floats:
        return self.example.episode.state_TS[self.invocation.tick]

    @property
    def cognition(self) -> None:
        return None

    @property
    def age_ns(self) -> int:
        return self.invocation.reference.age_ns

    @property
    def past(self) -> tuple[PastFrame, ...]:
        if self.is_embedded or self.sampling is None:
            return ()
        history = enumerate(self.example.episode.history)
        return self.sampling.read(
            {index: frame.astype(np.uint8, copy=False) for index, frame in history}, self.num_seen
        )

    @property
    def num_seen(self) -> int:
        """How much of the history the frame memory has seen."""
        if self.sampling is None:
            return 0
        tick = self.example.remembered_tick(self.invocation, self.sampling)
        return self.sampling.num_seen(self.example.episode.num_demo_history, tick)

    @property
    def subgoal(self) -> str:
        return self.example.told[self.place]


def collate_ponder(examples: Sequence[Example]) -> PonderBatch:
    """PONDER's side: rows and images."""
    return PonderBatch(
        rows=tuple(row for each in examples for row in each.rows),
        frames=tuple(frames for each in examples for frames in each.frames),
        rows_per_episode=tuple(len(each.rows) for each in examples),
    )


def collate_pounce(
    examples: Sequence[Example], config: AnyPounceConfig, tokenizer: AnyTokenizer, statistics: RobotStatistics
) -> PounceBatch:
    """POUNCE's side. Without pictures every camera counts as missing; pi0.5 only.

    Prompts of unequal length are padded: for pi0.5 on the right, masked; for GR00T on the left, as in its public data
    path. GR00T's mixer attends to this padding, which serving, one observation at a time, never has.

    Raises:
        ValueError: a prompt is longer than ``max_prompt_tokens``, the tokenizer is another family's, or the examples
            have no invocation.
    """
    sampling = sampling_of(config)
    moments = [
        _TrainingMoment(index=index, example=example, place=place, sampling=sampling)
        for index, example in enumerate(examples)
        for place in range(len(example.invocations))
    ]
    if not moments:
        raise ValueError(f"none of the {len(examples)} examples has an invocation to learn from")
    inputs: PounceInputs | GrootInputs
    if isinstance(config, PounceConfig) and isinstance(tokenizer, Tokenizer):
        seen = replace(config, windows=())  # the training set has looked through them
        inputs = joined_pi05([pi05_inputs(moment, seen, tokenizer, statistics, _CPU) for moment in moments])
        if moments[0].is_embedded:
            inputs = _with_features(inputs, moments)
    elif isinstance(config, GrootPounceConfig) and isinstance(tokenizer, EagleTokenizer):
        read = [groot_inputs(moment, config, tokenizer, statistics, _CPU) for moment in moments]
        inputs = joined_groot(_padded_on_the_left(read, tokenizer))
    else:
        raise ValueError(f"a {type(config).__name__} does not read with a {type(tokenizer).__name__}")
    actions_INA = torch.zeros(len(moments), config.horizon, config.padded_action_dim)
    first = 0
    for example in examples:
        ticks = np.array([invocation.tick for invocation in example.invocations], dtype=np.intp)
        episode = example.episode
        rows = chunk_ticks(ticks, config.horizon, episode.num_ticks)
        wanted = statistics.normalise_chunks(episode.action_TA, episode.state_TS[ticks], rows)
        actions_INA[first : first + len(ticks), :, : config.robot_action_dim] = torch.from_numpy(wanted)
        first += len(ticks)
    queries = [moment.invocation.reference.query for moment in moments]
    return PounceBatch(
        inputs=inputs,
        actions_INA=actions_INA,
        episode_I=torch.tensor([moment.index for moment in moments]),
        query_I=torch.tensor([NO_QUERY if query is None else query for query in queries]),
    )


def _with_features(inputs: PounceInputs, moments: Sequence[_TrainingMoment]) -> PounceInputs:
    """The inputs with what a frozen tower made of the views, and of the past in its slots, in the pictures' place."""
    seen_BSW = torch.from_numpy(np.stack([np.concatenate(moment.views) for moment in moments])).float()
    inputs = replace(inputs, seen=seen_BSW, has_view=torch.ones_like(inputs.has_view))
    sampling = moments[0].sampling
    if inputs.past_step is None or sampling is None:
        return inputs
    past_BFSW = torch.zeros(*inputs.past_step.shape, *moments[0].views[0].shape, dtype=torch.float16)
    past_step_BF = torch.full_like(inputs.past_step, NO_FRAME)
    for row, moment in enumerate(moments):
        for slot, index in enumerate(sampling.indices(moment.num_seen)):
            past_BFSW[row, slot] = torch.from_numpy(moment.example.episode.history[index])
            past_step_BF[row, slot] = index * sampling.stride_ticks
    return replace(inputs, past=past_BFSW, past_step=past_step_BF)


def _padded_on_the_left(inputs: Sequence[GrootInputs], tokenizer: EagleTokenizer) -> list[GrootInputs]:
    longest = max(one.token_ids.shape[1] for one in inputs)
    (pad,) = tokenizer.encode(_GROOT_PAD)
    return [
        replace(
            one,
            token_ids=F.pad(one.token_ids, (longest - one.token_ids.shape[1], 0), value=pad),
            is_token=F.pad(one.is_token, (longest - one.is_token.shape[1], 0), value=False),
        )
        for one in inputs
    ]
