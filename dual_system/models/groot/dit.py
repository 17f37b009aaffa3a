"""GR00T's diffusion transformer: even blocks cross-attend to the vision-language features, odd blocks self-attend.

Time enters as a style: scale and shift of every first norm. Styles depend on the time bucket only, and the keys
and values of even blocks on the observation only, so a sampler computes both once.
"""

# B batch, T tokens, S vision-language tokens, W width, L blocks, M = L + 1 styled norms

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.groot.blocks import BLOCK_NORM_EPS, BlockAttention, BlockConfig, BlockMlp
from dual_system.models.stack import Stack

OUT_NORM_EPS = 1e-6
MAX_PERIOD = 10_000.0


def bucket_features(bucket_B: Tensor, num_channels: int) -> Tensor:
    """Returns [cos | sin] of the bucket, (B, num_channels) float32: what the time MLP reads.

    float32 angles, as in the public code: weights were trained with their rounding.
    """
    half = num_channels // 2
    exponent = -math.log(MAX_PERIOD) * torch.arange(half, dtype=torch.float32, device=bucket_B.device) / (half - 1)
    angle = bucket_B[:, None].float() * exponent.exp()
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


def action_time_features(bucket_B: Tensor, width: int) -> Tensor:
    """Returns [sin | cos] of the bucket, (B, 1, width) float32, concatenated with every embedded action."""
    half = width // 2
    exponent = -torch.arange(half, dtype=torch.float32, device=bucket_B.device) * (math.log(MAX_PERIOD) / half)
    angle = bucket_B[:, None, None].float() * exponent.exp()
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def styled_norm(x_BTW: Tensor, style_2B1W: Tensor, eps: float) -> Tensor:
    """A LayerNorm without weights, scaled and shifted by the style."""
    one_plus_scale, shift = style_2B1W.unbind()
    normed = F.layer_norm(x_BTW.float(), x_BTW.shape[-1:], eps=eps)
    return torch.addcmul(shift, normed, one_plus_scale).to(x_BTW.dtype)


class AdaLayerNorm(nn.Module):
    """LayerNorm whose scale and shift are linear in silu(time)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 2 * width)

    def style(self, activated_time_BW: Tensor) -> Tensor:
        """Returns (2, B, 1, W): 1 + scale, shift."""
        scale, shift = self.linear(activated_time_BW).chunk(2, dim=-1)
        return torch.stack([1.0 + scale, shift])[:, :, None]


class DitBlock(nn.Module):
    """Only the first norm is styled; the second, before the MLP, has no weights at all."""

    def __init__(self, config: BlockConfig, source_width: int) -> None:
        super().__init__()
        self.norm1 = AdaLayerNorm(config.width)
        self.attn1 = BlockAttention(config, source_width)
        self.ff = BlockMlp(config)

    def forward(self, x_BTW: Tensor, style_2B1W: Tensor, keys_values: tuple[Tensor, Tensor] | None) -> Tensor:
        """``keys_values``: those of the features for cross-attention; None for self-attention."""
        normed_BTW = styled_norm(x_BTW, style_2B1W, BLOCK_NORM_EPS)
        x_BTW = x_BTW + self.attn1(normed_BTW, keys_values or self.attn1.keys_values(normed_BTW))
        plain_BTW = F.layer_norm(x_BTW.float(), x_BTW.shape[-1:], eps=BLOCK_NORM_EPS).to(x_BTW.dtype)
        mlp_BTW: Tensor = self.ff(plain_BTW)
        return x_BTW + mlp_BTW


class Dit(nn.Module):
    def __init__(self, config: BlockConfig, *, source_width: int, width_out: int, time_channels: int) -> None:
        super().__init__()
        width = config.width
        self.time_channels = time_channels
        self.time_mlp_in = nn.Linear(time_channels, width)
        self.time_mlp_out = nn.Linear(width, width)
        self.blocks = Stack[DitBlock](
            DitBlock(config, width if is_odd else source_width)
            for is_odd in (index % 2 for index in range(config.depth))
        )
        self.proj_out_1 = nn.Linear(width, 2 * width)
        self.proj_out_2 = nn.Linear(width, width_out)

    @property
    def stream_dtype(self) -> torch.dtype:
        return self.proj_out_2.weight.dtype

    def styles(self, bucket_B: Tensor) -> Tensor:
        """Returns (M, 2, B, 1, W): the styles of all first norms and of the last."""
        hidden_BW = F.silu(self.time_mlp_in(bucket_features(bucket_B, self.time_channels)))
        activated_BW = F.silu(self.time_mlp_out(hidden_BW))
        shift, scale = self.proj_out_1(activated_BW).chunk(2, dim=-1)  # the opposite order of the blocks'
        last = torch.stack([1.0 + scale, shift])[:, :, None]
        return torch.stack([*(block.norm1.style(activated_BW) for block in self.blocks), last])

    def read(self, features_BSX: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
        """Returns the keys and values of every even block."""
        return tuple(block.attn1.keys_values(features_BSX) for index, block in enumerate(self.blocks) if index % 2 == 0)

    def forward(self, x_BTW: Tensor, styles_M2B1W: Tensor, features_read: tuple[tuple[Tensor, Tensor], ...]) -> Tensor:
        """Returns (B, T, width_out)."""
        for index, block in enumerate(self.blocks):
            x_BTW = block(x_BTW, styles_M2B1W[index], None if index % 2 else features_read[index // 2])
        out_BTO: Tensor = self.proj_out_2(styled_norm(x_BTW, styles_M2B1W[-1], OUT_NORM_EPS))
        return out_BTO
