"""Batches of POUNCE inputs: pi0.5's are padded; GR00T's are grouped by length, because it attends to padding."""

# B moments, T text tokens

from collections.abc import Sequence

import torch
from torch import Tensor

from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.pi05.pounce import PounceInputs

PADDING_ID = 0
"""Any token id would do: pi0.5 masks it."""


def joined_pi05(inputs: Sequence[PounceInputs]) -> PounceInputs:
    """Batches all inputs. Shorter prompts are padded on the right: pi0.5 masks padding and gives it no position."""
    num_tokens = max(one.token_ids.shape[1] for one in inputs)
    cognition, is_null = _joined_cognition([one.cognition for one in inputs])
    states = [one.state for one in inputs]
    past, past_step = _joined_past(inputs)
    return PounceInputs(
        images=torch.cat([one.images for one in inputs]),
        has_view=torch.cat([one.has_view for one in inputs]),
        token_ids=torch.cat([_padded(one.token_ids, num_tokens) for one in inputs]),
        is_token=torch.cat([_padded(one.is_token, num_tokens) for one in inputs]),
        age_ns=torch.cat([one.age_ns for one in inputs]),
        cognition=cognition,
        is_null=is_null,
        state=None if None in states else torch.cat([state for state in states if state is not None]),
        past=past,
        past_step=past_step,
    )


def joined_groot(inputs: Sequence[GrootInputs]) -> GrootInputs:
    """Batches inputs of one group of `of_equal_length`."""
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
    """Groups the indices of inputs with equal prompt length, which may share a batch without padding."""
    groups: dict[int, list[int]] = {}
    for index, one in enumerate(inputs):
        groups.setdefault(one.token_ids.shape[1], []).append(index)
    return list(groups.values())


def _padded(values_1T: Tensor, num_tokens: int) -> Tensor:
    """Pads on the right with `PADDING_ID`, which is False in a mask."""
    return torch.nn.functional.pad(values_1T, (0, num_tokens - values_1T.shape[1]), value=PADDING_ID)


def _joined_past(inputs: Sequence[PounceInputs]) -> tuple[Tensor | None, Tensor | None]:
    """Past pictures (B, F, ...) and steps (B, F): of all samples or, without a frame memory, of none."""
    pasts = [(one.past, one.past_step) for one in inputs]
    given = [(past, step) for past, step in pasts if past is not None and step is not None]
    if not given:
        return None, None
    return torch.cat([past for past, _ in given]), torch.cat([step for _, step in given])


def _joined_cognition(cognitions: Sequence[Tensor | None]) -> tuple[Tensor | None, Tensor | None]:
    """Cognition (B, K, H) and a mask of its null samples; a null sample is zeros, which the learned null replaces."""
    given = next((one for one in cognitions if one is not None), None)
    if given is None:
        return None, None
    filled = torch.cat([torch.zeros_like(given) if one is None else one for one in cognitions])
    if not any(one is None for one in cognitions):
        return filled, None
    return filled, torch.tensor([one is None for one in cognitions], device=given.device)
