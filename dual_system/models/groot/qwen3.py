"""Qwen3's decoder layers as GR00T N1.5 uses them: causal, q/k-normalised heads, no LM head, all of one width."""

# B batch, T tokens, W width, h query heads, g key heads, D head dim

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.embedding import Embedding
from dual_system.models.pi05.gemma import Rotation, attend
from dual_system.models.stack import Stack


@dataclass(frozen=True, slots=True, kw_only=True)
class Qwen3Config:
    """Sizes of the decoder. ``depth`` counts the layers that are kept: GR00T N1.5 keeps 12 of 28."""

    width: int
    depth: int
    mlp_width: int
    num_heads: int = 16
    num_kv_heads: int = 8
    head_dim: int = 128
    vocab_size: int = 151_680
    rope_base: float = 1e6
    norm_eps: float = 1e-6

    def __post_init__(self) -> None:
        if self.num_heads % self.num_kv_heads:
            raise ValueError(f"{self.num_heads} query heads do not share {self.num_kv_heads} key heads evenly")
        if self.head_dim % 2:
            raise ValueError(f"head_dim {self.head_dim} is odd; RoPE rotates pairs")


class PlainRmsNorm(nn.Module):
    """RMSNorm that multiplies by the stored weight w, unlike Gemma's (1 + w)."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.weight = nn.Parameter(torch.empty(width))

    def forward(self, x: Tensor) -> Tensor:
        return F.rms_norm(x.float(), self.weight.shape, self.weight.float(), self.eps).to(x.dtype)


class Qwen3Attention(nn.Module):
    """Queries and keys are normalised per head before they are rotated."""

    def __init__(self, config: Qwen3Config) -> None:
        super().__init__()
        self.head_dim = config.head_dim
        self.q_proj = nn.Linear(config.width, config.num_heads * config.head_dim, bias=False)
        self.k_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.v_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.o_proj = nn.Linear(config.num_heads * config.head_dim, config.width, bias=False)
        self.q_norm = PlainRmsNorm(config.head_dim, config.norm_eps)
        self.k_norm = PlainRmsNorm(config.head_dim, config.norm_eps)

    def forward(self, x_BTW: Tensor, rotation: Rotation, bias_B1TT: Tensor) -> Tensor:
        q_BThD, k_BTgD, v_BTgD = (
            proj(x_BTW).unflatten(-1, (-1, self.head_dim)) for proj in (self.q_proj, self.k_proj, self.v_proj)
        )
        q_BhTD = rotation(self.q_norm(q_BThD).transpose(1, 2))
        k_BgTD = rotation(self.k_norm(k_BTgD).transpose(1, 2))
        out_BTW: Tensor = self.o_proj(attend(q_BhTD, k_BgTD, v_BTgD.transpose(1, 2), bias_B1TT))
        return out_BTW


class SwiGlu(nn.Module):
    def __init__(self, config: Qwen3Config) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(config.width, config.mlp_width, bias=False)
        self.up_proj = nn.Linear(config.width, config.mlp_width, bias=False)
        self.down_proj = nn.Linear(config.mlp_width, config.width, bias=False)

    def forward(self, x_BTW: Tensor) -> Tensor:
        out_BTW: Tensor = self.down_proj(F.silu(self.gate_proj(x_BTW)) * self.up_proj(x_BTW))
        return out_BTW


class Qwen3Layer(nn.Module):
    def __init__(self, config: Qwen3Config) -> None:
        super().__init__()
        self.input_layernorm = PlainRmsNorm(config.width, config.norm_eps)
        self.self_attn = Qwen3Attention(config)
        self.post_attention_layernorm = PlainRmsNorm(config.width, config.norm_eps)
        self.mlp = SwiGlu(config)

    def forward(self, x_BTW: Tensor, rotation: Rotation, bias_B1TT: Tensor) -> Tensor:
        x_BTW = x_BTW + self.self_attn(self.input_layernorm(x_BTW), rotation, bias_B1TT)
        mlp_BTW: Tensor = self.mlp(self.post_attention_layernorm(x_BTW))
        return x_BTW + mlp_BTW


def causal_bias(is_real_BT: Tensor, dtype: torch.dtype) -> Tensor:
    """Returns the attention bias, (B, 1, T, T): 0 where a row may attend, the lowest finite number elsewhere.

    Finite on purpose. A row of left padding may attend nowhere; the lowest number absorbs all its logits, so it
    averages every value, as in the public model, whose head then attends to that row.
    """
    num_tokens = is_real_BT.shape[1]
    causal_TT = torch.ones(num_tokens, num_tokens, dtype=torch.bool, device=is_real_BT.device).tril()
    visible_B1TT = causal_TT & is_real_BT[:, None, None, :]
    return torch.zeros_like(visible_B1TT, dtype=dtype).masked_fill(~visible_B1TT, torch.finfo(dtype).min)


class Qwen3(nn.Module):
    """Token embedding, the kept layers, and the last norm, which the public code applies to its last hidden state."""

    def __init__(self, config: Qwen3Config) -> None:
        super().__init__()
        self.config = config
        self.embed_tokens = Embedding(config.vocab_size, config.width)
        self.layers = Stack[Qwen3Layer](Qwen3Layer(config) for _ in range(config.depth))
        self.norm = PlainRmsNorm(config.width, config.norm_eps)

    def forward(self, embeds_BTW: Tensor, positions_BT: Tensor, is_real_BT: Tensor) -> Tensor:
        """Returns (B, T, W) after the last norm."""
        rotation = Rotation.at(positions_BT, self.config.head_dim, self.config.rope_base)
        bias_B1TT = causal_bias(is_real_BT, embeds_BTW.dtype)
        for layer in self.layers:
            embeds_BTW = layer(embeds_BTW, rotation, bias_B1TT)
        normed_BTW: Tensor = self.norm(embeds_BTW)
        return normed_BTW
