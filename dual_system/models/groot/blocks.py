"""Transformer blocks of GR00T's action head (attention with biases, tanh-GELU MLP); per-embodiment linear layers."""

# B batch, T query tokens, S key tokens, W width, h heads, D head dim, E embodiments, I in, O out

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.pi05.gemma import attend
from dual_system.models.siglip import Float32LayerNorm

BLOCK_NORM_EPS = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockConfig:
    """Sizes of a stack of blocks; its width is num_heads * head_dim."""

    depth: int
    num_heads: int
    head_dim: int
    mlp_width: int

    @property
    def width(self) -> int:
        return self.num_heads * self.head_dim


class BlockAttention(nn.Module):
    """Attention without a mask: like the public head it attends to padding too."""

    def __init__(self, config: BlockConfig, source_width: int) -> None:
        super().__init__()
        self.head_dim = config.head_dim
        self.to_q = nn.Linear(config.width, config.width)
        self.to_k = nn.Linear(source_width, config.width)
        self.to_v = nn.Linear(source_width, config.width)
        self.to_out = nn.Linear(config.width, config.width)

    def keys_values(self, source_BSX: Tensor) -> tuple[Tensor, Tensor]:
        """Returns keys and values of a source, both (B, h, S, D); a sampler computes them once per observation."""
        return self._heads(self.to_k(source_BSX)), self._heads(self.to_v(source_BSX))

    def forward(self, x_BTW: Tensor, keys_values: tuple[Tensor, Tensor]) -> Tensor:
        out_BTW: Tensor = self.to_out(attend(self._heads(self.to_q(x_BTW)), *keys_values, None))
        return out_BTW

    def _heads(self, x_BTW: Tensor) -> Tensor:
        return x_BTW.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


class BlockMlp(nn.Module):
    def __init__(self, config: BlockConfig) -> None:
        super().__init__()
        self.up = nn.Linear(config.width, config.mlp_width)
        self.down = nn.Linear(config.mlp_width, config.width)

    def forward(self, x_BTW: Tensor) -> Tensor:
        out_BTW: Tensor = self.down(F.gelu(self.up(x_BTW), approximate="tanh"))
        return out_BTW


class MixerBlock(nn.Module):
    """Self-attention over vision-language features, the trainable adapter between the frozen Eagle and the head."""

    def __init__(self, config: BlockConfig) -> None:
        super().__init__()
        self.norm1 = Float32LayerNorm(config.width, BLOCK_NORM_EPS)
        self.attn1 = BlockAttention(config, config.width)
        self.norm3 = Float32LayerNorm(config.width, BLOCK_NORM_EPS)
        self.ff = BlockMlp(config)

    def forward(self, x_BTW: Tensor) -> Tensor:
        normed_BTW = self.norm1(x_BTW)
        x_BTW = x_BTW + self.attn1(normed_BTW, self.attn1.keys_values(normed_BTW))
        mlp_BTW: Tensor = self.ff(self.norm3(x_BTW))
        return x_BTW + mlp_BTW


class Affine(NamedTuple):
    """One linear layer per sample: the weights of its embodiment."""

    weight_BIO: Tensor
    bias_B1O: Tensor

    def __call__(self, x_BTI: Tensor) -> Tensor:
        return torch.baddbmm(self.bias_B1O, x_BTI, self.weight_BIO)


class EmbodimentLinear(nn.Module):
    """A linear layer with separate weights for every embodiment; stored (E, in, out), like the public ones."""

    def __init__(self, num_embodiments: int, width_in: int, width_out: int) -> None:
        super().__init__()
        self.W = nn.Parameter(torch.empty(num_embodiments, width_in, width_out))
        self.b = nn.Parameter(torch.empty(num_embodiments, width_out))

    def of(self, embodiment_B: Tensor) -> Affine:
        return Affine(self.W[embodiment_B], self.b[embodiment_B][:, None])


class EmbodimentMlp(nn.Module):
    """Two embodiment-specific layers with a ReLU between."""

    def __init__(self, num_embodiments: int, width_in: int, width_hidden: int, width_out: int) -> None:
        super().__init__()
        self.layer1 = EmbodimentLinear(num_embodiments, width_in, width_hidden)
        self.layer2 = EmbodimentLinear(num_embodiments, width_hidden, width_out)

    def of(self, embodiment_B: Tensor) -> tuple[Affine, Affine]:
        return self.layer1.of(embodiment_B), self.layer2.of(embodiment_B)
