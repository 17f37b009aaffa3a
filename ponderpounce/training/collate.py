"""Examples become the batch that the joint model takes, with POUNCE's side read as ``pounce-serve`` reads a moment."""

# I invocations of all examples, V views, T tokens, N horizon, A padded action dim, U padded state dim

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from clock.sampling import SampledInvocation
from ponderpounce.models import groot_prompt, prompt
from ponderpounce.models.groot_prompt import EagleTokenizer
from ponderpounce.models.images import camera_batch
from ponderpounce.models.normalisation import RobotStatistics
from ponderpounce.models.pounce import PounceConfig, PounceInputs
from ponderpounce.models.pounce_checkpoint import AnyTokenizer
from ponderpounce.models.pounce_family import AnyPounceConfig
from ponderpounce.models.pounce_groot import GrootInputs, GrootPounceConfig
from ponderpounce.models.prompt import Tokenizer
from ponderpounce.training.example import Example, Frame, target_rows
from ponderpounce.training.joint import NO_QUERY, PonderBatch, PounceBatch

_GROOT_PAD = "<|endoftext|>"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Moment:
    """One invocation: what the robot saw and where it stood."""

    index: int
    """Of its example in the batch."""
    example: Example
    asked: SampledInvocation

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.example.episode.frames[self.asked.tick]

    @property
    def state(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return self.example.episode.state_T8[self.asked.tick]


def collate(
    examples: Sequence[Example], config: AnyPounceConfig, tokenizer: AnyTokenizer, statistics: RobotStatistics
) -> tuple[PonderBatch, PounceBatch]:
    """Examples as the joint model takes them.

    Prompts of unequal length are padded: on the right and masked for pi0.5. GR00T is padded on the left, as in its
    public data path; its mixer attends to the pads, which serving, one moment at a time, never has.

    Raises:
        ValueError: a prompt is longer than ``max_prompt_tokens``, or the tokenizer is another family's.
    """
    moments = [_Moment(index=i, example=e, asked=asked) for i, e in enumerate(examples) for asked in e.invocations]
    actions_INA = torch.zeros(len(moments), config.horizon, config.padded_action_dim)
    inputs: PounceInputs | GrootInputs
    if isinstance(config, PounceConfig) and isinstance(tokenizer, Tokenizer):
        inputs = _pi05_inputs(moments, config, tokenizer, statistics)
    elif isinstance(config, GrootPounceConfig) and isinstance(tokenizer, EagleTokenizer):
        inputs = _groot_inputs(moments, config, tokenizer, statistics)
    else:
        raise ValueError(f"a {type(config).__name__} does not read with a {type(tokenizer).__name__}")
    for place, moment in enumerate(moments):
        rows = target_rows(moment.example.episode, moment.asked.tick, config.horizon)
        wanted = torch.from_numpy(statistics.normalise_targets(rows, moment.state))
        actions_INA[place, :, : config.robot_action_dim] = wanted
    references = [moment.asked.reference for moment in moments]
    return PonderBatch(rows=tuple(e.row for e in examples), frames=tuple(e.frames for e in examples)), PounceBatch(
        inputs=inputs,
        actions_INA=actions_INA,
        episode_I=torch.tensor([moment.index for moment in moments]),
        query_I=torch.tensor([NO_QUERY if reference.query is None else reference.query for reference in references]),
    )


def _pi05_inputs(
    moments: Sequence[_Moment], config: PounceConfig, tokenizer: Tokenizer, statistics: RobotStatistics
) -> PounceInputs:
    images_IV3PP, has_view_IV = _pictures(moments, config.image_px)
    prompts = [
        tokenizer.encode(
            prompt.prompt_text(moment.example.episode.instruction, statistics.state.normalise(moment.state))
        )
        for moment in moments
    ]
    longest = max(len(ids) for ids in prompts)
    _check_length(longest, config.max_prompt_tokens)
    return PounceInputs(
        images=images_IV3PP,
        has_view=has_view_IV,
        token_ids=torch.tensor([ids + [0] * (longest - len(ids)) for ids in prompts]),
        is_token=torch.tensor([[place < len(ids) for place in range(longest)] for ids in prompts]),
        age_ns=_ages(moments),
    )


def _groot_inputs(
    moments: Sequence[_Moment], config: GrootPounceConfig, tokenizer: EagleTokenizer, statistics: RobotStatistics
) -> GrootInputs:
    images_IV3PP, _ = _pictures(moments, config.image_px)
    num_patches = config.groot.eagle.vision.num_patches
    instructions = {moment.example.episode.instruction for moment in moments}
    encoded = {
        text: tokenizer.encode(groot_prompt.prompt_text(text, config.num_cameras, num_patches)) for text in instructions
    }
    longest = max(len(ids) for ids in encoded.values())
    _check_length(longest - config.num_cameras * num_patches, config.max_prompt_tokens)
    (pad,) = tokenizer.encode(_GROOT_PAD)
    prompts = [encoded[moment.example.episode.instruction] for moment in moments]
    state_IU = torch.zeros(len(moments), config.groot.state_dim)
    for place, moment in enumerate(moments):
        state_IU[place, : config.robot_state_dim] = torch.from_numpy(statistics.state.normalise(moment.state))
    return GrootInputs(
        images=images_IV3PP,
        token_ids=torch.tensor([[pad] * (longest - len(ids)) + ids for ids in prompts]),
        is_token=torch.tensor([[place >= longest - len(ids) for place in range(longest)] for ids in prompts]),
        state=state_IU,
        embodiment=torch.full((len(moments),), config.embodiment),
        age_ns=_ages(moments),
    )


def _pictures(moments: Sequence[_Moment], image_px: int) -> tuple[Tensor, Tensor]:
    pairs = [camera_batch(moment.frames, image_px) for moment in moments]
    return torch.cat([images for images, _ in pairs]), torch.cat([has_view for _, has_view in pairs])


def _ages(moments: Sequence[_Moment]) -> Tensor:
    return torch.tensor([moment.asked.reference.age_ns for moment in moments])


def _check_length(num_tokens: int, max_tokens: int) -> None:
    if num_tokens > max_tokens:
        raise ValueError(f"a prompt has {num_tokens} tokens, expected at most {max_tokens} (max_prompt_tokens)")
