"""From one moment to the network's own batch of one, for each action model. Serving and training both read here."""

# P image side in px

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models.groot import prompt as groot_prompt
from dual_system.models.groot.pounce import GrootInputs, GrootPounceConfig
from dual_system.models.groot.prompt import EagleTokenizer
from dual_system.models.images import camera_batch
from dual_system.models.normalisation import Floats, RobotStatistics
from dual_system.models.pi05 import prompt as prompt
from dual_system.models.pi05.pounce import PounceConfig, PounceInputs
from dual_system.models.pi05.prompt import Tokenizer


class Moment(Protocol):
    """What an invocation is about: what the robot sees and is told, and which cognition it has."""

    @property
    def instruction(self) -> str: ...
    @property
    def frames(self) -> Sequence[NDArray[np.uint8] | None]:
        """(h, w, 3) uint8 per camera; None for one that did not deliver."""
        ...

    @property
    def proprio(self) -> Floats:
        """(8,) joint positions (rad) and finger opening (m)."""
        ...

    @property
    def cognition(self) -> Floats | None:
        """(K, H); None in training, where it is on the graph, and for the learned null."""
        ...

    @property
    def age_ns(self) -> int: ...
    @property
    def subgoal(self) -> str:
        """What PONDER last told itself to do; empty before it did. Models with ``reads_subgoal`` read it."""
        ...


def pi05_inputs(
    moment: Moment, config: PounceConfig, tokenizer: Tokenizer, statistics: RobotStatistics, device: torch.device
) -> PounceInputs:
    """No mask hides anything but a missing camera.

    Raises:
        ValueError: the prompt is too long.
    """
    images, has_view = camera_batch(moment.frames, config.image_px)
    state = statistics.normalise_states(moment.proprio)
    has_token = config.state_input == "token"
    text = prompt.stateless_prompt_text if has_token else partial(prompt.prompt_text, state=state)
    token_ids = tokenizer.encode(text(_told(moment, config.reads_subgoal)))
    _check_length(len(token_ids), config.max_prompt_tokens, moment.instruction)
    return PounceInputs(
        images=images.to(device),
        has_view=has_view.to(device),
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        age_ns=torch.tensor([moment.age_ns], device=device),
        cognition=_cognition(moment, device),
        state=torch.from_numpy(state)[None].to(device) if has_token else None,
    )


def groot_inputs(
    moment: Moment,
    config: GrootPounceConfig,
    tokenizer: EagleTokenizer,
    statistics: RobotStatistics,
    device: torch.device,
) -> GrootInputs:
    """A missing camera is a black picture: GR00T tells cameras apart by their order only, so none is left out.

    Raises:
        ValueError: the prompt is too long.
    """
    images, _ = camera_batch(moment.frames, config.image_px)
    num_patches = config.groot.eagle.vision.num_patches
    told = _told(moment, config.reads_subgoal)
    token_ids = tokenizer.encode(groot_prompt.prompt_text(told, config.num_cameras, num_patches))
    num_text = len(token_ids) - config.num_cameras * num_patches
    _check_length(num_text, config.max_prompt_tokens, moment.instruction)
    state = torch.zeros(1, config.groot.state_dim)
    state[0, : config.robot_state_dim] = torch.from_numpy(statistics.normalise_states(moment.proprio))
    return GrootInputs(
        images=images.to(device),
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        state=state.to(device),
        embodiment=torch.tensor([config.embodiment], device=device),
        age_ns=torch.tensor([moment.age_ns], device=device),
        cognition=_cognition(moment, device),
    )


def _told(moment: Moment, reads_subgoal: bool) -> str:
    return prompt.with_subgoal(moment.instruction, moment.subgoal) if reads_subgoal else moment.instruction


def _cognition(moment: Moment, device: torch.device) -> Tensor | None:
    if moment.cognition is None:
        return None
    # Copied into aligned memory: where a NumPy array happens to lie changes the last bit of a product.
    return torch.tensor(moment.cognition, device=device)[None]


def _check_length(num_tokens: int, max_tokens: int, instruction: str) -> None:
    if num_tokens > max_tokens:
        raise ValueError(
            f"prompt has {num_tokens} tokens, expected at most {max_tokens} "
            f"(max_prompt_tokens); shorten the instruction {instruction[:60]!r}"
        )
