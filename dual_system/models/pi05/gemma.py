"""Gemma layers as pi0.5 uses them: a plain stream for images and text, an adaRMS stream for the actions."""

# B batch, T query tokens, S key tokens, W width, h query heads, g key heads, D head dim
# M norms of the expert (two per layer and the last), E expert width

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.embedding import Embedding
from dual_system.models.stack import Stack

RMS_NORM_EPS = 1e-6
ROPE_BASE = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GemmaConfig:
    """Sizes of one stream. Both streams of pi0.5 share depth, heads and head_dim; widths differ."""

    width: int
    depth: int
    mlp_width: int
    num_heads: int = 8
    num_kv_heads: int = 1
    head_dim: int = 256

    def __post_init__(self) -> None:
        if self.num_heads % self.num_kv_heads:
            raise ValueError(f"{self.num_heads} query heads do not share {self.num_kv_heads} key heads evenly")
        if self.head_dim % 2:
            raise ValueError(f"head_dim {self.head_dim} is odd; RoPE rotates pairs")


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """RoPE at given positions: cosines and sines, (B, 1, T, D/2) float32."""

    cos: Tensor
    sin: Tensor

    @classmethod
    def at(cls, positions_BT: Tensor, head_dim: int, base: float = ROPE_BASE) -> "Rotation":
        exponent = torch.arange(0, head_dim, 2, dtype=torch.float32, device=positions_BT.device) / head_dim
        angle_B1TD = positions_BT[:, None, :, None].float() / base**exponent
        return cls(angle_B1TD.cos(), angle_B1TD.sin())

    def __call__(self, x_BhTD: Tensor) -> Tensor:
        """Rotates pairs (i, i + D/2): the half-split convention, in float32."""
        first, second = x_BhTD.float().chunk(2, dim=-1)
        rotated = (first * self.cos - second * self.sin, second * self.cos + first * self.sin)
        return torch.cat(rotated, dim=-1).to(x_BhTD.dtype)


def attend(q_BhTD: Tensor, k_BgSD: Tensor, v_BgSD: Tensor, visible: Tensor | None) -> Tensor:
    """Grouped-query attention -> (B, T, h*D). ``visible``, bool or a bias, broadcasts to (B, 1, T, S); None means all.

    Hidden keys get weight exactly 0, where the public code adds -2.38e38 to their logits: the results are equal
    for every row that sees at least one key.

    The query heads that share a key head become rows of one head: with a mask, torch's fused GPU kernels do not
    support grouped heads, and its fallback computes in float32 and without tensor cores.
    """
    (batch_size, heads, num_queries, head_dim), key_heads = q_BhTD.shape, k_BgSD.shape[1]
    if k_BgSD.requires_grad and not k_BgSD.is_cuda:
        # A CPU's backward pass is as fast with groups, and sums the heads in the order of every earlier training.
        mixed_BhTD = F.scaled_dot_product_attention(q_BhTD, k_BgSD, v_BgSD, attn_mask=visible, enable_gqa=True)
        return mixed_BhTD.transpose(1, 2).flatten(2)
    group = heads // key_heads
    if visible is not None and visible.shape[2] > 1:
        visible = visible.repeat(1, 1, group, 1)
    rows_BgRD = q_BhTD.reshape(batch_size, key_heads, group * num_queries, head_dim)
    mixed_BgRD = F.scaled_dot_product_attention(rows_BgRD, k_BgSD, v_BgSD, attn_mask=visible)
    return mixed_BgRD.unflatten(2, (group, num_queries)).permute(0, 3, 1, 2, 4).flatten(2)


class Attention(nn.Module):
    """The four projections of one stream; the softmax itself runs jointly over both streams (`attend`)."""

    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        self.head_dim = config.head_dim
        self.q_proj = nn.Linear(config.width, config.num_heads * config.head_dim, bias=False)
        self.k_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.v_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.o_proj = nn.Linear(config.num_heads * config.head_dim, config.width, bias=False)

    def qkv(self, x_BTW: Tensor, rotation: Rotation) -> tuple[Tensor, Tensor, Tensor]:
        """Returns rotated queries (B, h, T, D), rotated keys and plain values (B, g, T, D)."""
        q_BhTD, k_BgTD, v_BgTD = (
            proj(x_BTW).unflatten(-1, (-1, self.head_dim)).transpose(1, 2)
            for proj in (self.q_proj, self.k_proj, self.v_proj)
        )
        return rotation(q_BhTD), rotation(k_BgTD), v_BgTD


class GeGlu(nn.Module):
    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(config.width, config.mlp_width, bias=False)
        self.up_proj = nn.Linear(config.width, config.mlp_width, bias=False)
        self.down_proj = nn.Linear(config.mlp_width, config.width, bias=False)

    def forward(self, x_BTW: Tensor) -> Tensor:
        gate = F.gelu(self.gate_proj(x_BTW), approximate="tanh")
        out_BTW: Tensor = self.down_proj(gate * self.up_proj(x_BTW))
        return out_BTW


class RmsNorm(nn.Module):
    """Gemma's RMSNorm: the stored weight w multiplies as (1 + w)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(width))

    def forward(self, x_BTW: Tensor) -> Tensor:
        weight = 1.0 + self.weight.float()
        return F.rms_norm(x_BTW.float(), weight.shape, weight, RMS_NORM_EPS).to(x_BTW.dtype)


class AdaRmsNorm(nn.Module):
    """RMSNorm whose scale, shift and residual gate are linear in the time condition (adaRMS)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dense = nn.Linear(width, 3 * width)

    def style(self, cond_BE: Tensor) -> Tensor:
        """Returns (3, B, 1, E): 1 + scale, shift, gate. They depend on time only, so a sampler tabulates them."""
        scale, shift, gate = self.dense(cond_BE).chunk(3, dim=-1)
        return torch.stack([1.0 + scale, shift, gate])[:, :, None]

    def style_shift(self, cond_BE: Tensor) -> Tensor:
        """Returns (3, B, 1, E): what a further condition adds to `style`, which is linear in it."""
        shift_B3E = F.linear(cond_BE, self.dense.weight).unflatten(-1, (3, -1))
        return shift_B3E.transpose(0, 1)[:, :, None]

    def forward(self, x_BTE: Tensor, style_3B1E: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the styled norm of ``x_BTE`` and the gate for the residual that follows."""
        one_plus_scale, shift, gate = style_3B1E.unbind()
        normed = F.rms_norm(x_BTE.float(), x_BTE.shape[-1:], None, RMS_NORM_EPS)
        return torch.addcmul(shift, normed, one_plus_scale).to(x_BTE.dtype), gate.to(x_BTE.dtype)


class GemmaLayer(nn.Module):
    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        self.input_layernorm = RmsNorm(config.width)
        self.self_attn = Attention(config)
        self.post_attention_layernorm = RmsNorm(config.width)
        self.mlp = GeGlu(config)


class ExpertLayer(nn.Module):
    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        self.input_layernorm = AdaRmsNorm(config.width)
        self.self_attn = Attention(config)
        self.post_attention_layernorm = AdaRmsNorm(config.width)
        self.mlp = GeGlu(config)


class LanguageModel(nn.Module):
    """Gemma over [cognition][images][text]: token embedding, layers, last norm. pi0.5 uses no LM head."""

    def __init__(self, config: GemmaConfig, vocab_size: int) -> None:
        super().__init__()
        self.embed_tokens = Embedding(vocab_size, config.width)
        self.layers = Stack[GemmaLayer](GemmaLayer(config) for _ in range(config.depth))
        self.norm = RmsNorm(config.width)

    def embed(self, token_ids_BT: Tensor) -> Tensor:
        """Returns text embeddings times sqrt(width); image and cognition tokens are not scaled."""
        embeds_BTW: Tensor = self.embed_tokens(token_ids_BT)
        return embeds_BTW * math.sqrt(embeds_BTW.shape[-1])


class ActionExpert(nn.Module):
    """The action stream's layers and last norm, all adaRMS."""

    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        self.layers = Stack[ExpertLayer](ExpertLayer(config) for _ in range(config.depth))
        self.norm = AdaRmsNorm(config.width)

    def styles(self, cond_BE: Tensor) -> Tensor:
        """Returns (M, 3, B, 1, E): the styles of all norms in the order of the forward pass."""
        return torch.stack([norm.style(cond_BE) for norm in self._norms()])

    def style_shift(self, cond_BE: Tensor) -> Tensor:
        """Returns (M, 3, B, 1, E): what ``cond_BE`` adds to every norm's style if it is added to the condition."""
        return torch.stack([norm.style_shift(cond_BE) for norm in self._norms()])

    def _norms(self) -> list[AdaRmsNorm]:
        norms = [norm for layer in self.layers for norm in (layer.input_layernorm, layer.post_attention_layernorm)]
        return [*norms, self.norm]
