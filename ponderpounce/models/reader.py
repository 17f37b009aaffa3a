"""Weights of their own for demonstrations: a reader watches, the others act, and both keep one memory.

A second copy of the language model's layers reads an episode with a demonstration up to the end of the first query: it
takes the notes, and says at the first look what is to be done. Keys, values and recurrent states that it leaves are
what the first copy goes on from. So what is learned of demonstrations changes nothing where there are none, to the last
bit, and what acts stays as it is. Tokens of several kinds with weights of their own that share attention are known from
Mixture-of-Transformers (arXiv:2411.04996); pi0's action expert is one. The paper's PONDER has one set of weights.

Embeddings, vision tower and LM head are shared.

# B rows, T tokens, H hidden, D head dimension, C conv channels, W conv width, N tokens of one kind
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from transformers.models.qwen3_5.modeling_qwen3_5 import causal_conv1d_fn

from ponderpounce.models.gated_delta import gated_delta_rule
from ponderpounce.models.ponder_kernels import rotate

PerToken = Callable[[Tensor], Tensor]
"""(N, width in) to (N, width out), every token by itself."""


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
        order = torch.cat([torch.nonzero(each.flatten())[:, 0] for each in (is_read_BT, ~is_read_BT)])
        self._num_read = int(is_read_BT.sum())
        is_in_order = bool((order == torch.arange(len(order))).all())  # one row alone: its beginning is the reader's
        self._order = None if is_in_order else order.to(device)
        self._back = None if is_in_order else order.argsort().to(device)

    def each(self, reading: PerToken, acting: PerToken, x_BTX: Tensor) -> Tensor:
        """Every token through what its kind has; (B, T, width out)."""
        x_MX = x_BTX.flatten(0, 1)
        x_MX = x_MX if self._order is None else x_MX[self._order]
        parts = ((reading, x_MX[: self._num_read]), (acting, x_MX[self._num_read :]))
        y_MY = torch.cat([through(part) for through, part in parts if len(part)])
        y_MY = y_MY if self._back is None else y_MY[self._back]
        return y_MY.unflatten(0, x_BTX.shape[:2])


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
        normed_BTH = kinds.each(reading.input_layernorm, acting.input_layernorm, hidden)
        if hasattr(acting, "self_attn"):
            mixed_BTH = _attention(kinds, reading.self_attn, acting.self_attn, normed_BTH, cos_sin)
        else:
            mixed_BTH = _gated_delta(kinds, reading.linear_attn, acting.linear_attn, normed_BTH)
        hidden = hidden + mixed_BTH
        hidden = hidden + kinds.each(_thinking(reading), _thinking(acting), hidden)
    return kinds.each(reader.norm, text_model.norm, hidden)


def _thinking(layer: Any) -> PerToken:
    def think(x_NH: Tensor) -> Tensor:
        y_NH: Tensor = layer.mlp(layer.post_attention_layernorm(x_NH))
        return y_NH

    return think


def _attention(kinds: _Kinds, reading: Any, acting: Any, x_BTH: Tensor, cos_sin: tuple[Tensor, Tensor]) -> Tensor:
    size, groups = acting.head_dim, acting.num_key_value_groups

    def projecting(attention: Any) -> PerToken:
        def project(x_NH: Tensor) -> Tensor:
            queries_ND, gate_ND = attention.q_proj(x_NH).unflatten(-1, (-1, 2 * size)).chunk(2, dim=-1)
            keys_ND = attention.k_norm(attention.k_proj(x_NH).unflatten(-1, (-1, size)))
            wanted = [attention.q_norm(queries_ND), gate_ND, keys_ND]
            return torch.cat([*(each.flatten(1) for each in wanted), attention.v_proj(x_NH)], dim=-1)

        return project

    def finishing(attention: Any) -> PerToken:
        def finish(seen_and_gate: Tensor) -> Tensor:
            seen, gate = seen_and_gate.chunk(2, dim=-1)
            y_NH: Tensor = attention.o_proj(seen * gate.sigmoid())
            return y_NH

        return finish

    projected = kinds.each(projecting(reading), projecting(acting), x_BTH)
    heads = projected.shape[-1] // size // (2 * groups + 2)  # of keys
    sizes = [heads * groups * size, heads * groups * size, heads * size, heads * size]
    queries, gate, keys, values = projected.split(sizes, dim=-1)
    queries, keys, values = (each.unflatten(-1, (-1, size)).transpose(1, 2) for each in (queries, keys, values))
    queries, keys = rotate(queries, keys, *cos_sin)
    # every head with keys of its own: only for 16-bit numbers do torch's fused kernels know groups
    keys, values = (each.repeat_interleave(groups, dim=1) for each in (keys, values))
    seen = F.scaled_dot_product_attention(queries, keys, values, scale=acting.scaling, is_causal=True)
    return kinds.each(finishing(reading), finishing(acting), torch.cat([seen.transpose(1, 2).flatten(2), gate], dim=-1))


def _gated_delta(kinds: _Kinds, reading: Any, acting: Any, x_BTH: Tensor) -> Tensor:
    batch, length, _ = x_BTH.shape
    sizes = [acting.key_dim, acting.key_dim, acting.value_dim]

    def projecting(delta: Any) -> PerToken:
        def project(x_NH: Tensor) -> Tensor:
            beta, gate = delta.in_proj_b(x_NH).sigmoid(), delta.in_proj_z(x_NH)
            return torch.cat([delta.in_proj_qkv(x_NH), beta, gate], dim=-1)

        return project

    def decaying(delta: Any) -> PerToken:
        def decay(x_NH: Tensor) -> Tensor:
            logs_NV: Tensor = -delta.A_log.float().exp() * F.softplus(delta.in_proj_a(x_NH).float() + delta.dt_bias)
            return logs_NV

        return decay

    def finishing(delta: Any) -> PerToken:
        def finish(read_and_gate: Tensor) -> Tensor:
            read, gate = (each.reshape(-1, delta.head_v_dim) for each in read_and_gate.chunk(2, dim=-1))
            y_NH: Tensor = delta.out_proj(delta.norm(read, gate).reshape(len(read_and_gate), delta.value_dim))
            return y_NH

        return finish

    def convolved(delta: Any, inputs_BCT: Tensor) -> Tensor:
        weight, bias = delta.conv1d.weight.squeeze(1), delta.conv1d.bias
        mixed_BCT: Tensor = causal_conv1d_fn(inputs_BCT, weight, bias, activation=delta.activation)
        return mixed_BCT

    projected = kinds.each(projecting(reading), projecting(acting), x_BTH)
    inputs, beta, gate = projected.split([sum(sizes), acting.num_v_heads, acting.value_dim], dim=-1)
    inputs_BCT = inputs.transpose(1, 2)
    mixed_BCT = torch.where(kinds.is_read_BT[:, None], convolved(reading, inputs_BCT), convolved(acting, inputs_BCT))
    queries, keys, values = mixed_BCT.transpose(1, 2).split(sizes, dim=-1)
    read, _ = gated_delta_rule(
        queries.reshape(batch, length, -1, acting.head_k_dim),
        keys.reshape(batch, length, -1, acting.head_k_dim),
        values.reshape(batch, length, -1, acting.head_v_dim),
        g=kinds.each(decaying(reading), decaying(acting), x_BTH),
        beta=beta,
        use_qk_l2norm_in_kernel=True,
    )
    return kinds.each(finishing(reading), finishing(acting), torch.cat([read.flatten(2), gate], dim=-1))
