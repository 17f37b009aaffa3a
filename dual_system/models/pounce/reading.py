"""Converts one observation to a batch of one for each action model; shared by serving and training."""

# P image side in px

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models.frame_sampling import PastFrame
from dual_system.models.groot import prompt as groot_prompt
from dual_system.models.groot.pounce import GrootInputs, GrootPounceConfig
from dual_system.models.groot.prompt import EagleTokenizer
from dual_system.models.images import camera_batch, resize_with_pad
from dual_system.models.normalisation import Floats, RobotStatistics
from dual_system.models.pi05 import prompt as prompt
from dual_system.models.pi05.modulation import NO_FRAME
from dual_system.models.pi05.pounce import PounceConfig, PounceInputs
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.resize import resized_views
from dual_system.models.windows import seen_through, through


class Moment(Protocol):
    """Inputs of one invocation: instruction, frames, proprioception, and the cognition with its age."""

    @property
    def instruction(self) -> str: ...
    @property
    def frames(self) -> Sequence[NDArray[np.uint8] | None]:
        """(h, w, 3) uint8 per camera; None for a missing one."""
        ...

    @property
    def proprio(self) -> Floats:
        """(8,) joint positions (rad) and finger opening (m)."""
        ...

    @property
    def cognition(self) -> Floats | None:
        """(K, H); None for the learned null, and in training, where it stays in the autograd graph."""
        ...

    @property
    def age_ns(self) -> int: ...
    @property
    def subgoal(self) -> str:
        """PONDER's newest subgoal; empty before the first. Models with ``reads_subgoal`` read it."""
        ...

    @property
    def past(self) -> Sequence[PastFrame]:
        """Front pictures of the past, oldest first, as `FrameSampling` chooses them; for models with a frame memory."""
        ...


def pi05_inputs(
    moment: Moment, config: PounceConfig, tokenizer: Tokenizer, statistics: RobotStatistics, device: torch.device
) -> PounceInputs:
    """Inputs for pi0.5; its view mask is False only for missing cameras.

    Raises:
        ValueError: the prompt is too long.
    """
    frames = through(config.windows, moment.frames, (config.image_px, config.image_px))
    images, has_view = _views(frames, config.image_px, device)
    state = statistics.normalise_states(moment.proprio)
    token_ids = pi05_prompt(_instruction(moment, config.reads_subgoal), state, config, tokenizer)
    return PounceInputs(
        images=images,
        has_view=has_view,
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        age_ns=torch.tensor([moment.age_ns], device=device),
        cognition=_cognition(moment, device),
        state=torch.from_numpy(state)[None].to(device) if config.state_input == "token" else None,
        **_past(moment, config, device),
    )


def groot_inputs(
    moment: Moment,
    config: GrootPounceConfig,
    tokenizer: EagleTokenizer,
    statistics: RobotStatistics,
    device: torch.device,
) -> GrootInputs:
    """Inputs for GR00T. A missing camera is a black picture: GR00T identifies cameras by their order only.

    Raises:
        ValueError: the prompt is too long, or its image tokens are not one per patch of the frames.
    """
    images, _ = _views(moment.frames, config.image_px, device)
    if images.shape[1] != config.num_cameras:
        raise ValueError(
            f"expected a frame of each of {config.num_cameras} cameras, came {images.shape[1]}; the model was saved "
            "with other cameras"
        )
    token_ids = groot_prompt_ids(_instruction(moment, config.reads_subgoal), config, tokenizer)
    state = torch.zeros(1, config.groot.state_dim)
    state[0, : config.robot_state_dim] = torch.from_numpy(statistics.normalise_states(moment.proprio))
    return GrootInputs(
        images=images,
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        state=state.to(device),
        embodiment=torch.tensor([config.embodiment], device=device),
        age_ns=torch.tensor([moment.age_ns], device=device),
        cognition=_cognition(moment, device),
    )


def require_prompt(
    instruction: str, config: PounceConfig | GrootPounceConfig, tokenizer: Tokenizer | EagleTokenizer
) -> None:
    """Raises ValueError if POUNCE cannot read an instruction, even beside a state of the fewest digits."""
    if isinstance(config, PounceConfig) and isinstance(tokenizer, Tokenizer):
        pi05_prompt(instruction, np.full(config.robot_state_dim, -1.0, dtype=np.float32), config, tokenizer)
    elif isinstance(config, GrootPounceConfig) and isinstance(tokenizer, EagleTokenizer):
        groot_prompt_ids(instruction, config, tokenizer)


def pi05_prompt(instruction: str, state: Floats, config: PounceConfig, tokenizer: Tokenizer) -> list[int]:
    """Token ids of the prompt; ``state`` is normalised. Raises ValueError if the prompt is too long."""
    has_token = config.state_input == "token"
    text = _STATELESS[config.stateless_prompt] if has_token else partial(prompt.prompt_text, state=state)
    token_ids = tokenizer.encode(text(instruction))
    _check_length(len(token_ids), config.max_prompt_tokens, instruction, 0 if has_token else len(state))
    return token_ids


def groot_prompt_ids(instruction: str, config: GrootPounceConfig, tokenizer: EagleTokenizer) -> list[int]:
    """Token ids of the prompt with an image token a patch. Raises ValueError if it is too long, or has others."""
    num_patches = config.groot.eagle.vision.num_patches
    token_ids = tokenizer.encode(groot_prompt.prompt_text(instruction, config.num_cameras, num_patches))
    num_slots, image_id = config.num_cameras * num_patches, config.groot.eagle.image_token_id
    if token_ids.count(image_id) != num_slots:
        raise ValueError(
            f"expected {num_slots} image tokens (id {image_id}), one per patch of {config.num_cameras} cameras, came "
            f"{token_ids.count(image_id)}; the model was saved with another tokenizer.json"
        )
    _check_length(len(token_ids) - num_slots, config.max_prompt_tokens, instruction)
    return token_ids


def _past(moment: Moment, config: PounceConfig, device: torch.device) -> dict[str, Any]:
    """Past pictures as they are resized for the present one, in as many slots as the memory has, empty ones last."""
    if config.frame_memory is None:
        return {}
    num_frames, size_px = config.frame_memory.sampling.num_frames, config.image_px
    past = torch.zeros(1, num_frames, 3, size_px, size_px, dtype=torch.uint8)
    steps = [each.step for each in moment.past]
    for slot, frame in enumerate(each.frame for each in moment.past):
        seen = seen_through(config.windows[0], frame, (size_px, size_px)) if config.windows else frame
        past[0, slot] = ((resize_with_pad(seen, size_px) + 1.0) * 127.5).round()
    steps += [NO_FRAME] * (num_frames - len(steps))
    return {"past": past.to(device), "past_step": torch.tensor([steps], device=device)}


def _views(frames: Sequence[NDArray[np.uint8] | None], size_px: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`camera_batch`, resized where it costs less: a GPU's views have the same bits."""
    if device.type != "cuda":
        images, has_view = camera_batch(frames, size_px)
        return images.to(device), has_view.to(device)
    has_view = torch.tensor([[frame is not None for frame in frames]], dtype=torch.bool, device=device)
    return resized_views(frames, size_px, device), has_view


_STATELESS = {"instruction": prompt.stateless_prompt_text, "task": prompt.task_only_prompt_text}


def _instruction(moment: Moment, reads_subgoal: bool) -> str:
    return prompt.with_subgoal(moment.instruction, moment.subgoal) if reads_subgoal else moment.instruction


def _cognition(moment: Moment, device: torch.device) -> Tensor | None:
    if moment.cognition is None:
        return None
    # Copied into aligned memory: a NumPy array's alignment changes the last bit of a product.
    return torch.tensor(moment.cognition, device=device)[None]


def _check_length(num_tokens: int, max_tokens: int, instruction: str, num_state: int = 0) -> None:
    """Raises ValueError for a prompt that is too long. ``num_state``: how many numbers of the state it spells."""
    if num_tokens > max_tokens:
        also = f", or read its {num_state} numbers of state as one token (state_input)" if num_state else ""
        raise ValueError(
            f"prompt has {num_tokens} tokens, expected at most {max_tokens} "
            f"(max_prompt_tokens); shorten the instruction {instruction[:60]!r}{also}"
        )
