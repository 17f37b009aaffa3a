"""Several moments as one batch: what may be padded is, what may not is kept apart."""

# B moments, T text tokens

from collections.abc import Sequence

import torch
from torch import Tensor

from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.pi05.pounce import PounceInputs

PADDING_ID = 0
"""Any token will do: pi0.5 masks it."""


def joined_pi05(inputs: Sequence[PounceInputs]) -> PounceInputs:
    """One batch of all. Shorter prompts are padded on the right: pi0.5 neither sees nor counts padding."""
    num_tokens = max(one.token_ids.shape[1] for one in inputs)
    cognition, is_null = _joined_cognition([one.cognition for one in inputs])
    states = [one.state for one in inputs]
    return PounceInputs(
        images=torch.cat([one.images for one in inputs]),
        has_view=torch.cat([one.has_view for one in inputs]),
        token_ids=torch.cat([_padded(one.token_ids, num_tokens) for one in inputs]),
        is_token=torch.cat([_padded(one.is_token, num_tokens) for one in inputs]),
        age_ns=torch.cat([one.age_ns for one in inputs]),
        cognition=cognition,
        is_null=is_null,
        state=None if None in states else torch.cat([state for state in states if state is not None]),
    )


def joined_groot(inputs: Sequence[GrootInputs]) -> GrootInputs:
    """One batch of `of_equal_length` moments."""
    cognition, is_null = _joined_cognition([one.cognition for one in inputs])
    return GrootInputs(
        images=torch.cat([one.images for one in inputs]),
        token_ids=torch.cat([one.token_ids for one in inputs]),
        is_token=torch.cat([one.is_token for one in inputs]),
        state=torch.cat([one.state for one in inputs]),
        embodiment=torch.cat([one.embodiment for one in inputs]),
        age_ns=torch.cat([one.age_ns for one in inputs]),
        cognition=cognition,
        is_null=is_null,
    )


def of_equal_length(inputs: Sequence[GrootInputs]) -> list[list[int]]:
    """Indices of the moments that may share a batch: GR00T attends to padding, so there must be none."""
    groups: dict[int, list[int]] = {}
    for index, one in enumerate(inputs):
        groups.setdefault(one.token_ids.shape[1], []).append(index)
    return list(groups.values())


def _padded(values_1T: Tensor, num_tokens: int) -> Tensor:
    """False for masks, as 0 is."""
    return torch.nn.functional.pad(values_1T, (0, num_tokens - values_1T.shape[1]), value=PADDING_ID)


def _joined_cognition(cognitions: Sequence[Tensor | None]) -> tuple[Tensor | None, Tensor | None]:
    """Cognition and which of it is null; zeros stand where the learned null will."""
    given = next((one for one in cognitions if one is not None), None)
    if given is None:
        return None, None
    filled = torch.cat([torch.zeros_like(given) if one is None else one for one in cognitions])
    if not any(one is None for one in cognitions):
        return filled, None
    return filled, torch.tensor([one is None for one in cognitions], device=given.device)
