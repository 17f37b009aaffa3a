"""A POUNCE that reads other words goes on from what one can do already: subgoals in place of cognition, which is the
paper's subgoal-text reference, or the instructions of more tasks (`widening`).

Everything of the same name and shape is taken; what has no counterpart is drawn.
"""

from __future__ import annotations

import torch

from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.pounce.checkpoint import PounceBundle, random_bundle
from dual_system.models.pounce.family import AnyPounceConfig

_WORDS = "pi05.language.embed_tokens.weight"


@torch.no_grad()
def told_in_words(
    knowing: PounceBundle, config: AnyPounceConfig, tokenizer: Tokenizer | None, seed: int
) -> PounceBundle:
    """A POUNCE of ``config`` with the skill of another.

    If ``config`` reads subgoals the cognition prefix is left out. Words are drawn anew: with another
    tokenizer they are other words.

    Raises ValueError unless both are pi0.5 of one size.
    """
    if not isinstance(config, PounceConfig) or not isinstance(knowing.model.config, PounceConfig):
        raise ValueError("only a pi0.5 is taken over as one that reads other words; start GR00T from its public folder")
    fresh = random_bundle(config, seed, statistics=knowing.statistics, tokenizer=tokenizer or knowing.tokenizer)
    known, weights = knowing.model.state_dict(), fresh.model.state_dict()
    taken = {name for name in weights if name in known and (name != _WORDS or tokenizer is None)}
    misshapen = sorted(name for name in taken if known[name].shape != weights[name].shape)
    missing = sorted(weights.keys() - known.keys())
    if misshapen or missing:
        raise ValueError(f"the given POUNCE has another size than the recipe's: {[*misshapen, *missing][:5]}")
    fresh.model.load_state_dict({name: known[name] if name in taken else drawn for name, drawn in weights.items()})
    return fresh
