"""Examples become the batch that the joint model takes, POUNCE's side read by what ``pounce-serve`` reads with."""

# I invocations of all examples, N horizon, A padded action dim

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from clock.sampling import SampledInvocation
from dual_system.models.groot.pounce import GrootInputs, GrootPounceConfig
from dual_system.models.groot.prompt import EagleTokenizer
from dual_system.models.normalisation import Floats, RobotStatistics
from dual_system.models.pi05.pounce import PounceConfig, PounceInputs
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.pounce.batching import joined_groot, joined_pi05
from dual_system.models.pounce.checkpoint import AnyTokenizer
from dual_system.models.pounce.family import AnyPounceConfig
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from dual_system.training.chunks import chunk_ticks
from dual_system.training.example import Example
from dual_system.training.joint import NO_QUERY, PonderBatch, PounceBatch
from dual_system.training.nudge import apply_nudges
from dual_system.training.training_episode import Frame

_GROOT_PAD = "<|endoftext|>"
_CPU = torch.device("cpu")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Asked:
    """One invocation as a `pounce_reading.Moment`. Its cognition comes later: it is on the graph."""

    index: int
    """Of its example in the batch."""
    example: Example
    invocation: SampledInvocation

    @property
    def instruction(self) -> str:
        return self.example.episode.instruction

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.example.episode.frames[self.invocation.tick]

    @property
    def proprio(self) -> Floats:
        return self.example.episode.state_T8[self.invocation.tick]

    @property
    def cognition(self) -> None:
        return None

    @property
    def age_ns(self) -> int:
        return self.invocation.reference.age_ns

    @property
    def subgoal(self) -> str:
        query = self.invocation.reference.query
        return "" if query is None else self.example.said[query]


def collate_ponder(
    examples: Sequence[Example],
    *,
    with_rows: bool = True,
    stand_in_size: int = 0,
    moved_weight: float = 1.0,
    place_size: int = 0,
) -> PonderBatch:
    """PONDER's side: rows and pictures, stand-ins of ``stand_in_size`` numbers, place lessons for hidden states of
    ``place_size``; what is not asked is not made. ``moved_weight``: see `Example.stand_in_weights`."""
    rows = tuple(each.row() for each in examples) if with_rows else ()
    are_weighed = moved_weight != 1 or any(each.asks_for_no_cognition for each in examples)
    taught = zip(examples, rows, strict=True) if place_size else ()
    return PonderBatch(
        rows=rows,
        place_lessons=tuple(each.place_lessons(row, place_size) for each, row in taught),
        frames=tuple(each.frames() for each in examples) if with_rows else (),
        stand_ins=tuple(each.stand_ins(stand_in_size) for each in examples) if stand_in_size else (),
        stand_in_weights=tuple(each.stand_in_weights(moved_weight) for each in examples) if are_weighed else (),
    )


def collate_pounce(
    examples: Sequence[Example],
    config: AnyPounceConfig,
    tokenizer: AnyTokenizer,
    statistics: RobotStatistics,
) -> PounceBatch:
    """POUNCE's side. Without pictures (`Sight`) it is as if no camera had delivered; pi0.5 only.

    Prompts of unequal length are padded: on the right and masked for pi0.5. GR00T is padded on the left, as in its
    public data path; its mixer attends to the pads, which serving, one moment at a time, never has.

    Raises:
        ValueError: a prompt is longer than ``max_prompt_tokens``, the tokenizer is another family's, or all episodes
            are watched ones.
    """
    moments = [_Asked(index=n, example=e, invocation=i) for n, e in enumerate(examples) for i in e.invocations]
    if not moments:
        raise ValueError("no episode of this share of the batch is to be imitated: lower --watch-share")
    inputs: PounceInputs | GrootInputs
    if isinstance(config, PounceConfig) and isinstance(tokenizer, Tokenizer):
        inputs = joined_pi05([pi05_inputs(moment, config, tokenizer, statistics, _CPU) for moment in moments])
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
        wanted = statistics.normalise_chunks(episode.action_T8, episode.state_T8[ticks], rows)
        actions_INA[first : first + len(ticks), :, : config.robot_action_dim] = torch.from_numpy(wanted)
        first += len(ticks)
    nudges = [example.nudges_I2 for example in examples]
    if examples and all(each is not None for each in nudges):
        if not isinstance(inputs, PounceInputs) or inputs.state is None:
            raise ValueError("starts are nudged for a pi0.5 that reads its state as a token")
        every_I2 = np.concatenate([each for each in nudges if each is not None])
        state, actions_INA = apply_nudges(examples[0].nudge, every_I2, inputs.state, actions_INA, statistics)
        inputs = replace(inputs, state=state)
    queries = [moment.invocation.reference.query for moment in moments]
    return PounceBatch(
        inputs=inputs,
        actions_INA=actions_INA,
        episode_I=torch.tensor([moment.index for moment in moments]),
        query_I=torch.tensor([NO_QUERY if query is None else query for query in queries]),
    )


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
