"""Qwen3.5's text stack as captured forwards read it: matrix products as modules, and the numbers between them.

The modules are the network's own, whatever their precision is. What lies between them is prepared once: norms' scales
in float32, and the two small projections of a recurrent layer as one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from dual_system.models.fp8 import Fp8Linear
from dual_system.models.kernels.rms_norm import Style
from ponder_server.kernels.rotate_store import HeadNorms

Product = Callable[[Tensor], Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class AttentionLayer:
    """An attention layer's products and head norms."""

    queries_gates: Product
    keys: Product
    values: Product
    norms: HeadNorms
    out: Product

    @classmethod
    def of(cls, attention: Any) -> "AttentionLayer":
        norms = HeadNorms(_scale(attention.q_norm), _scale(attention.k_norm), attention.q_norm.eps)
        return cls(attention.q_proj, attention.k_proj, attention.v_proj, norms, attention.o_proj)

    @property
    def inputs(self) -> tuple[Product, Product, Product]:
        """Those of `Projected`."""
        return self.queries_gates, self.keys, self.values


@dataclass(frozen=True, slots=True, eq=False)
class DeltaLayer:
    """A Gated DeltaNet layer's products and numbers; C conv channels, W conv width, V value heads of size E."""

    inputs: Product
    gate: Product
    out: Product
    conv_CW: Tensor
    speed_beta_XH: Tensor
    a_log_V: Tensor
    dt_bias_V: Tensor
    norm_E: Tensor
    eps: float

    @classmethod
    def of(cls, delta: Any) -> "DeltaLayer":
        assert delta.conv1d.bias is None, "Qwen3.5's convolutions have no bias"
        return cls(
            inputs=delta.in_proj_qkv,
            gate=delta.in_proj_z,
            out=delta.out_proj,
            conv_CW=delta.conv1d.weight.squeeze(1),
            speed_beta_XH=torch.cat([delta.in_proj_a.weight, delta.in_proj_b.weight]),
            a_log_V=delta.A_log,
            dt_bias_V=delta.dt_bias,
            norm_E=delta.norm.weight,
            eps=delta.norm.variance_epsilon,
        )

    def speed_beta(self, normed_BTH: Tensor) -> Tensor:
        """The projections [a | b], (B, T, 2 V)."""
        return F.linear(normed_BTH, self.speed_beta_XH)


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One layer: a mixer of tokens, then the MLP."""

    index: int
    input_norm: Style
    mixer: AttentionLayer | DeltaLayer
    mlp_norm: Style
    gate: Product
    up: Product
    down: Product


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """All layers, and the norm at their end."""

    layers: list[Layer]
    norm: Style
    rotary: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """(embeddings, positions (3, B, T)) -> cos and sin (B, T, rotary dimensions)."""
    dtype: torch.dtype

    @property
    def multiplies_fp8(self) -> bool:
        """Whether products are fp8 products, of rows that are quantised before them."""
        product = self.layers[0].gate
        return isinstance(product, Fp8Linear) and product.multiplies and self.dtype == torch.bfloat16

    @classmethod
    def of(cls, text_model: Any) -> "Stack":
        layers = [
            Layer(
                index=index,
                input_norm=_style(layer.input_layernorm),
                mixer=DeltaLayer.of(layer.linear_attn)
                if hasattr(layer, "linear_attn")
                else AttentionLayer.of(layer.self_attn),
                mlp_norm=_style(layer.post_attention_layernorm),
                gate=layer.mlp.gate_proj,
                up=layer.mlp.up_proj,
                down=layer.mlp.down_proj,
            )
            for index, layer in enumerate(text_model.layers)
        ]
        return cls(layers, _style(text_model.norm), text_model.rotary_emb, text_model.norm.weight.dtype)


def _style(norm: Any) -> Style:
    return Style(scale=_scale(norm), eps=norm.eps)


def _scale(norm: Any) -> Tensor:
    return 1.0 + norm.weight.detach().float()
