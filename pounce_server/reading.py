"""From a request to the network's own batch of one, for each action model. Nothing is padded."""

# P image side in px

from collections.abc import Sequence

import torch
from torch import Tensor

from ponderpounce.models import groot_prompt, prompt, rtc
from ponderpounce.models.groot_prompt import EagleTokenizer
from ponderpounce.models.images import camera_batch
from ponderpounce.models.normalisation import RobotStatistics
from ponderpounce.models.pounce import PounceConfig, PounceInputs
from ponderpounce.models.pounce_groot import GrootInputs, GrootPounceConfig
from ponderpounce.models.prompt import Tokenizer
from pounce_server.contract import Request


def pi05_inputs(
    request: Request, config: PounceConfig, tokenizer: Tokenizer, statistics: RobotStatistics, device: torch.device
) -> PounceInputs:
    """No mask hides anything but a missing camera.

    Raises:
        ValueError: the prompt is too long.
    """
    images, has_view = camera_batch(request.frames, config.image_px)
    state = statistics.state.normalise(request.proprio)
    token_ids = tokenizer.encode(prompt.prompt_text(request.instruction, state))
    _check_length(len(token_ids), config.max_prompt_tokens, request.instruction)
    return PounceInputs(
        images=images.to(device),
        has_view=has_view.to(device),
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        age_ns=torch.tensor([request.age_ns], device=device),
        cognition=_cognition(request, device),
    )


def groot_inputs(
    request: Request,
    config: GrootPounceConfig,
    tokenizer: EagleTokenizer,
    statistics: RobotStatistics,
    device: torch.device,
) -> GrootInputs:
    """A missing camera is a black picture: GR00T tells cameras apart by their order only, so none is left out.

    Raises:
        ValueError: the prompt is too long.
    """
    images, _ = camera_batch(request.frames, config.image_px)
    num_patches = config.groot.eagle.vision.num_patches
    token_ids = tokenizer.encode(groot_prompt.prompt_text(request.instruction, config.num_cameras, num_patches))
    num_text = len(token_ids) - config.num_cameras * num_patches
    _check_length(num_text, config.max_prompt_tokens, request.instruction)
    state = torch.zeros(1, config.groot.state_dim)
    state[0, : config.robot_state_dim] = torch.from_numpy(statistics.state.normalise(request.proprio))
    return GrootInputs(
        images=images.to(device),
        token_ids=torch.tensor([token_ids], device=device),
        is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=device),
        state=state.to(device),
        embodiment=torch.tensor([config.embodiment], device=device),
        age_ns=torch.tensor([request.age_ns], device=device),
        cognition=_cognition(request, device),
    )


def guide(
    requests: Sequence[Request], config: PounceConfig, statistics: RobotStatistics, device: torch.device
) -> rtc.Guide | None:
    """Returns where the previous rows pull each request's chunk; None if nobody has any that the chunk reaches."""
    shape = (len(requests), config.horizon, config.padded_action_dim)
    target_BNA, weight_BNA = torch.zeros(shape), torch.zeros(shape)
    dims = config.robot_action_dim
    for index, request in enumerate(requests):
        first = request.previous_row0
        if request.previous_rows is None or first >= config.horizon:
            continue
        rows_n8 = statistics.normalise_targets(request.previous_rows, request.proprio)[: config.horizon - first]
        mask = rtc.soft_mask(config.horizon - first, len(rows_n8), min(request.committed_rows, len(rows_n8)))
        target_BNA[index, first : first + len(rows_n8), :dims] = torch.from_numpy(rows_n8)
        weight_BNA[index, first:, :dims] = mask[:, None]
    if not weight_BNA.any():
        return None
    return rtc.Guide(target=target_BNA.to(device), weight=weight_BNA.to(device))


def _cognition(request: Request, device: torch.device) -> Tensor | None:
    if request.cognition is None:
        return None
    # Copied into aligned memory: where a NumPy array happens to lie changes the last bit of a product.
    return torch.tensor(request.cognition, device=device)[None]


def _check_length(num_tokens: int, max_tokens: int, instruction: str) -> None:
    if num_tokens > max_tokens:
        raise ValueError(
            f"prompt has {num_tokens} tokens, expected at most {max_tokens} "
            f"(max_prompt_tokens); shorten the instruction {instruction[:60]!r}"
        )
