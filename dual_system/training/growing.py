"""A larger PONDER that says and thinks what it did before: something to learn with, on top of what is known.

More layers: copies of the ones below them whose ways out are zero, so the residual stream passes them unchanged until
training opens them (stacking, Gong et al. 2019; zeroed ways out as in ReZero, Bachlechner et al. 2021). A broader
residual stream, more heads and more neurons: nobody writes into the new numbers yet and nothing new writes into the old
ones; what reads is drawn, so that what writes learns from the first step on (Net2Net, Chen et al. 2016, with zeros in
place of copies: two equal neurons stay equal).
"""

# H numbers of the residual stream

from __future__ import annotations

import copy
import re
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import PounceBundle

_LAYER = re.compile(r"(.*language_model\.layers\.)(\d+)(\..*)")
_WAY_OUT = re.compile(r"(out_proj|o_proj|down_proj)\.weight$")
_BLOCK = re.compile(r"(.*visual\.blocks\.)(\d+)(\..*)")
_BLOCK_OUT = re.compile(r"(attn\.proj|mlp\.linear_fc2)\.(weight|bias)$")
_READS = re.compile(r"(in_proj_\w+|[qkv]_proj|gate_proj|up_proj|conv1d)\.weight$")
_OF_THE_STREAM = re.compile(r"(input_layernorm|post_attention_layernorm|language_model\.norm)\.weight$")
_OF_HEADS = re.compile(r"(A_log|dt_bias)$")
_MIXED = re.compile(r"(in_proj_qkv|conv1d)\.weight$")  # queries, keys and values of Gated DeltaNet, one after the other


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
    return _with_copies(ponder, config, _LAYER, _WAY_OUT, num_old, num_new)


def seeing_deeper(ponder: Ponder, num_new: int) -> Ponder:
    """Returns a PONDER with so many more layers of its vision tower, copies of the last ones; it sees what it saw.

    Raises ValueError unless there are as many layers to copy.
    """
    config: Any = copy.deepcopy(ponder.qwen.config)
    num_old = config.vision_config.depth
    if not 0 < num_new <= num_old:
        raise ValueError(f"eyes of {num_old} layers can grow by 1 to {num_old} more, not by {num_new}")
    config.vision_config.depth = num_old + num_new
    return _with_copies(ponder, config, _BLOCK, _BLOCK_OUT, num_old, num_new)


def _with_copies(
    ponder: Ponder, config: Any, layer: re.Pattern[str], way_out: re.Pattern[str], num_old: int, num_new: int
) -> Ponder:
    """A PONDER of ``config``: layers behind the old ones are copies of the last, their ways out zero."""
    new = ponder.reshaped(config)
    known = ponder.qwen.state_dict()
    weights = {}
    for name, drawn in new.qwen.state_dict().items():
        found = layer.fullmatch(name)
        if found is None or int(found[2]) < num_old:
            weights[name] = known[name]
        elif way_out.search(name):
            weights[name] = torch.zeros_like(drawn)
        else:
            weights[name] = known[f"{found[1]}{int(found[2]) - num_new}{found[3]}"].clone()
    new.qwen.load_state_dict(weights)
    new.is_random = ponder.is_random
    return new


@torch.no_grad()
def broadened(ponder: Ponder, hidden_size: int, ffn_size: int, *, seed: int = 0) -> Ponder:
    """Returns a PONDER with a residual stream of ``hidden_size`` numbers, as many times the heads, and MLPs of
    ``ffn_size``. The first numbers of its hidden states are the old ones' (up to rounding), the others are zero.

    Raises ValueError if it would be smaller, or heads do not come out even.
    """
    config: Any = copy.deepcopy(ponder.qwen.config)
    text = config.text_config
    old_size = text.hidden_size
    if hidden_size < old_size or ffn_size < text.intermediate_size:
        raise ValueError(
            f"expected at least the {old_size} numbers and {text.intermediate_size} neurons that there are, "
            f"came {hidden_size} and {ffn_size}"
        )
    counts = ("num_attention_heads", "num_key_value_heads", "linear_num_key_heads", "linear_num_value_heads")
    for name in counts:
        count, rest = divmod(getattr(text, name) * hidden_size, old_size)
        if rest:
            raise ValueError(
                f"{name}: {getattr(text, name)} heads for {old_size} do not come out even at {hidden_size}"
            )
        setattr(text, name, count)
    text.hidden_size, text.intermediate_size = hidden_size, ffn_size
    config.vision_config.out_hidden_size = hidden_size
    new = ponder.reshaped(config)
    before: Any = ponder.qwen.config.text_config
    blocks = [(rows, there.start) for rows, there in zip(_mixed(before), _mixed(text), strict=True)]
    generator = torch.Generator().manual_seed(seed)
    known, weights = ponder.qwen.state_dict(), {}
    for name, drawn in sorted(new.qwen.state_dict().items()):
        old = known[name]
        if old.shape == drawn.shape:
            weights[name] = old
        elif _OF_THE_STREAM.search(name):
            # the mean of squares is now over numbers of which some are zero; RMSNorm scales by 1 + w
            share = (old_size / hidden_size) ** 0.5
            weights[name] = torch.full_like(drawn, share - 1)
            weights[name][:old_size] = (1 + old) * share - 1
        elif _OF_HEADS.search(name):
            weights[name] = old.repeat(-(-len(drawn) // len(old)))[: len(drawn)]
        else:
            value = torch.zeros(drawn.shape)
            if _READS.search(name):
                value.normal_(0.0, float(old.float().std()), generator=generator)
            value = value.to(drawn)
            for rows, first in blocks if _MIXED.search(name) else [(slice(len(old)), 0)]:
                part = old[rows]
                value[(slice(first, first + len(part)), *(slice(size) for size in old.shape[1:]))] = part
            weights[name] = value
    new.qwen.load_state_dict(weights)
    new.is_random = ponder.is_random
    return new


def _mixed(text: Any) -> list[slice]:
    """Where queries, keys and values lie among the rows of Gated DeltaNet's first product."""
    keys = text.linear_num_key_heads * text.linear_key_head_dim
    values = text.linear_num_value_heads * text.linear_value_head_dim
    return [slice(0, keys), slice(keys, 2 * keys), slice(2 * keys, 2 * keys + values)]


@torch.no_grad()
def reading_more(bundle: PounceBundle, cognition_size: int) -> PounceBundle:
    """The same POUNCE for cognitions of more numbers, of which it reads those that it knows.

    Raises ValueError if it is not pi0.5's kind, or reads more already.
    """
    model = bundle.model
    if not isinstance(model, Pounce):
        raise ValueError("only pi0.5's cognition prefix is known to grow, GR00T's is pretrained for one size")
    size = model.config.cognition.cognition_size
    if cognition_size < size:
        raise ValueError(f"it reads cognitions of {size} numbers; {cognition_size} would be fewer")
    cognition = replace(model.config.cognition, cognition_size=cognition_size)
    new = Pounce(replace(model.config, cognition=cognition))
    known = model.state_dict()
    new.load_state_dict({name: _padded(known[name], drawn) for name, drawn in new.state_dict().items()})
    return replace(bundle, model=new)


def _padded(old: Tensor, like: Tensor) -> Tensor:
    """With zeros behind its last numbers, as many as there are in ``like``."""
    if old.shape == like.shape:
        return old
    value = torch.zeros_like(like)
    value[..., : old.shape[-1]] = old
    return value
