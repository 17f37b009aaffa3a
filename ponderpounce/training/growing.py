"""A PONDER with more layers that says and thinks what it did before: something to learn with, on top of what is known.

New layers are copies of the ones below them whose ways out are zero, so the residual stream passes them unchanged until
training opens them (stacking, Gong et al. 2019; zeroed ways out as in ReZero, Bachlechner et al. 2021).
"""

from __future__ import annotations

import copy
import re
from typing import Any

import torch

from ponderpounce.models.ponder import Ponder

_LAYER = re.compile(r"(.*language_model\.layers\.)(\d+)(\..*)")
_WAY_OUT = re.compile(r"(out_proj|o_proj|down_proj)\.weight$")


def grown(ponder: Ponder, num_new: int = 2) -> Ponder:
    """Returns a PONDER with so many layers more, of the kinds of its last ones; its hidden states are the same.

    Raises ValueError unless there are as many layers to copy.
    """
    config: Any = copy.deepcopy(ponder.qwen.config)
    text = config.text_config
    num_old = text.num_hidden_layers
    if not 0 < num_new <= num_old:
        raise ValueError(f"a PONDER of {num_old} layers can grow by 1 to {num_old} more, not by {num_new}")
    text.num_hidden_layers = num_old + num_new
    text.layer_types = [*text.layer_types, *text.layer_types[-num_new:]]
    new = Ponder(config, ponder.format, image_px=ponder.image_px, device=ponder.device, dtype=ponder.dtype)
    known = ponder.qwen.state_dict()
    weights = {}
    for name, drawn in new.qwen.state_dict().items():
        found = _LAYER.fullmatch(name)
        if found is None or int(found[2]) < num_old:
            weights[name] = known[name]
        elif _WAY_OUT.search(name):
            weights[name] = torch.zeros_like(drawn)
        else:
            weights[name] = known[f"{found[1]}{int(found[2]) - num_new}{found[3]}"].clone()
    new.qwen.load_state_dict(weights)
    new.is_random = ponder.is_random
    return new
