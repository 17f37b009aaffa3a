"""Tokens that end a generated text, and those that it may contain: the same in training and serving.

# V vocabulary
"""

import torch
from torch import Tensor

from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_policy import OWN_TEXTS, TextPolicy
from dual_system.models.ponder.vocabulary import Vocabulary


def ends_of_text(vocabulary: Vocabulary, policy: TextPolicy = OWN_TEXTS) -> frozenset[int]:
    """Tokens that end a text and are not part of it."""
    ends = {vocabulary.t_no}
    if policy.reasoning == "owed":
        ends.add(vocabulary.t_yes)
    if policy.ends == "control":
        ends |= {vocabulary.end_of_text, vocabulary.im_end}
    return frozenset(ends)


def allowed_tokens(ponder: Ponder, *, ends: bool) -> Tensor:
    """Tokens allowed in a text, (V,) bool: unless the policy masks nothing, no control tokens, carriers or unused rows;
    end tokens if ``ends``."""
    vocabulary, policy = ponder.format.vocabulary, ponder.format.texts
    is_text_V = torch.zeros(ponder.vocab_size, dtype=torch.bool)
    is_text_V[: vocabulary.num_tokens] = True
    is_text_V[list(vocabulary.control_ids)] = False
    if not policy.masked:
        is_text_V[:] = True
        is_text_V[vocabulary.image_pad] = False  # the row's positions are derived from it
    elif policy.reasoning == "any":
        is_text_V[vocabulary.t_yes] = True
    is_text_V[list(ends_of_text(vocabulary, policy))] = ends
    return is_text_V.to(ponder.device)
