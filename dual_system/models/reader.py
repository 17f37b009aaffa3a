"""Weights of their own for demonstrations: a reader watches, the others act, and both keep one memory.

A second copy of the language model's layers reads an episode with a demonstration up to the end of the first query: it
takes the notes, and says at the first look what is to be done. Keys, values and recurrent states that it leaves are
what the first copy goes on from. So what is learned of demonstrations changes nothing where there are none, to the last
bit, and what acts stays as it is. Tokens of several kinds with weights of their own that share attention are known from
Mixture-of-Transformers (arXiv:2411.04996); pi0's action expert is one. The paper's PONDER has one set of weights.

Embeddings, vision tower and LM head are shared.

# B rows, T tokens, H hidden, h heads, g heads of keys, D head dimension, E value dimensions, C conv channels
# V value heads, X all numbers of a token, N tokens of one kind
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from transformers.models.qwen3_5.modeling_qwen3_5 import causal_conv1d_fn

from dual_system.models.ponder import mixers as mixers
from dual_system.models.ponder.gated_delta import gated_delta_rule
from dual_system.models.ponder.kernels import rotate

PerToken = Callable[..., tuple[Tensor, ...]]
"""One or more (N, width in) to one or more (N, width out), every token by itself."""


class Reader(nn.Module):
    """Layers and last norm for demonstrations, called as transformers' text model is (``ponder_server/decoder.py``)."""

    def __init__(self, layers: nn.ModuleList, norm: nn.Module, rotary_emb: nn.Module) -> None:
        super().__init__()
        self.layers = layers
        self.norm: Any = norm
        self.rotary_emb = rotary_emb

    @classmethod
    def like(cls, text_model: Any) -> Self:
        """One that reads as ``text_model`` does, with weights of its own."""
        layers, norm = copy.deepcopy(text_model.layers), copy.deepcopy(text_model.norm)
        return cls(layers, norm, text_model.rotary_emb)


class _Kinds:
    """Which tokens of a batch are the reader's."""

    def __init__(self, num_read_B: Sequence[int], length: int, device: torch.device) -> None:
        is_read_BT = torch.arange(length) < torch.tensor(list(num_read_B))[:, None]
        self.is_read_BT = is_read_BT.to(device)
        self.range_read = min(num_read_B), max(num_read_B)
        """How many tokens of every row, and of any row, are the reader's."""
        order = torch.cat([torch.nonzero(each.flatten())[:, 0] for each in (is_read_BT, ~is_read_BT)])
        self._num_read = int(is_read_BT.sum())
        is_in_order = bool((order == torch.arange(len(order))).all())  # one row alone: its beginning is the reader's
        self._order = None if is_in_order else order.to(device)
        self._back = None if is_in_order else order.argsort().to(device)

    def each(self, reading: PerToken, acting: PerToken, *given_BTX: Tensor) -> tuple[Tensor, ...]:
        """Every token through what its kind has; each (B, T, width out)."""
        given = [self._sorted(x_BTX) for x_BTX in given_BTX]
        parts = ((reading, slice(self._num_read)), (acting, slice(self._num_read, None)))
        found = [through(*(x_MX[part] for x_MX in given)) for through, part in parts if len(given[0][part])]
        shape = given_BTX[0].shape[:2]
        return tuple(self._unsorted(torch.cat(same)).unflatten(0, shape) for same in zip(*found, strict=True))

    def _sorted(self, x_BTX: Tensor) -> Tensor:
        """The reader's tokens first, (B T, width)."""
        x_MX = x_BTX.flatten(0, 1)
        return x_MX if self._order is None else x_MX[self._order]

    def _unsorted(self, x_MX: Tensor) -> Tensor:
        return x_MX if self._back is None else x_MX[self._back]


def read_apart(
    text_model: Any, reader: Reader, embeds_BTH: Tensor, positions_4BT: Tensor, num_read_B: Sequence[int]
) -> Tensor:
    """Final hidden states (B, T, H), after the last norm, of whole rows whose first ``num_read_B`` tokens are the
    reader's; causal, as ``Ponder.forward``. Rows may be padded on the right."""
    kinds = _Kinds(num_read_B, embeds_BTH.shape[1], embeds_BTH.device)
    cos_sin = text_model.rotary_emb(embeds_BTH, positions_4BT[1:])
    hidden = embeds_BTH
    layers: Any = reader.layers
    for reading, acting in zip(layers, text_model.layers, strict=True):
        if hasattr(acting, "self_attn"):
            mixed_BTH = _attention(kinds, reading, acting, hidden, cos_sin)
        else:
            mixed_BTH = _gated_delta(kinds, reading, acting, hidden)
        hidden = hidden + mixed_BTH
        (thought_BTH,) = kinds.each(_thinking(reading), _thinking(acting), hidden)
        hidden = hidden + thought_BTH
    (normed_BTH,) = kinds.each(_alone(reader.norm), _alone(text_model.norm), hidden)
    return normed_BTH


def _alone(module: Any) -> PerToken:
    return lambda x_NH: (module(x_NH),)


def _thinking(layer: Any) -> PerToken:
    return lambda x_NH: (layer.mlp(layer.post_attention_layernorm(x_NH)),)


def _attention(kinds: _Kinds, reading: Any, acting: Any, x_BTH: Tensor, cos_sin: tuple[Tensor, Tensor]) -> Tensor:
    groups = acting.self_attn.num_key_value_groups

    def projecting(layer: Any) -> PerToken:
        return lambda x_NH: mixers.ask(layer.self_attn, layer.input_layernorm(x_NH))

    def finishing(layer: Any) -> PerToken:
        return lambda seen_NhD, gate_NhD: (mixers.attended(layer.self_attn, seen_NhD, gate_NhD),)

    *projected, gate_BThD = kinds.each(projecting(reading), projecting(acting), x_BTH)
    queries, keys, values = (each.transpose(1, 2) for each in projected)
    queries, keys = rotate(queries, keys, *cos_sin)
    # every head with keys of its own: only for 16-bit numbers do torch's fused kernels know groups
    keys, values = (each.repeat_interleave(groups, dim=1) for each in (keys, values))
    scale = acting.self_attn.scaling
    seen = F.scaled_dot_product_attention(queries, keys, values, scale=scale, is_causal=True)
    (mixed_BTH,) = kinds.each(finishing(reading), finishing(acting), seen.transpose(1, 2), gate_BThD)
    return mixed_BTH


def _gated_delta(kinds: _Kinds, reading: Any, acting: Any, x_BTH: Tensor) -> Tensor:
    def projecting(layer: Any) -> PerToken:
        return lambda x_NH: mixers.write(layer.linear_attn, layer.input_layernorm(x_NH))

    def finishing(layer: Any) -> PerToken:
        delta = layer.linear_attn
        return lambda read_NVE, gate_NX: (delta.out_proj(mixers.normed(delta, read_NVE, gate_NX)),)

    inputs_BTC, decay, beta, gate = kinds.each(projecting(reading), projecting(acting), x_BTH)
    mixed_BTC = _convolved(kinds, reading.linear_attn, acting.linear_attn, inputs_BTC)
    grouped = mixers.heads(acting.linear_attn, mixed_BTC)
    read, _ = gated_delta_rule(*grouped, g=decay, beta=beta, use_qk_l2norm_in_kernel=True)
    (mixed_BTH,) = kinds.each(finishing(reading), finishing(acting), read, gate)
    return mixed_BTH


def _convolved(kinds: _Kinds, reading: Any, acting: Any, inputs_BTC: Tensor) -> Tensor:
    """Each token by its kind's convolution, over its own and the other's inputs before it; (B, T, C)."""

    def through(delta: Any, first: int, end: int) -> Tensor:
        before = min(first, delta.conv_kernel_size - 1)
        inputs_BCT = inputs_BTC[:, first - before : end].transpose(1, 2)
        weight, bias = delta.conv1d.weight.squeeze(1), delta.conv1d.bias
        mixed_BCT: Tensor = causal_conv1d_fn(inputs_BCT, weight, bias, activation=delta.activation)
        return mixed_BCT[:, :, before:].transpose(1, 2)

    length, (first, last) = inputs_BTC.shape[1], kinds.range_read
    between = slice(first, last)  # where it depends on the row
    pieces = [through(reading, 0, last), through(acting, first, length)]
    is_read_BT1 = kinds.is_read_BT[:, between, None]
    both = torch.where(is_read_BT1, pieces[0][:, between], pieces[1][:, : last - first])
    return torch.cat([pieces[0][:, :first], both, pieces[1][:, last - first :]], dim=1)
