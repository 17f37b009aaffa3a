"""SigLIP vision tower: pixels to one feature per patch, without a pooling head (So400m/14 in pi0.5)."""

# B images, S patches, W width, h heads, D head dim, M mlp width, P image px

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.embedding import Embedding
from dual_system.models.stack import Stack

LAYER_NORM_EPS = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionConfig:
    """Sizes of a SigLIP tower; images are square."""

    width: int
    depth: int
    num_heads: int
    mlp_width: int
    image_px: int = 224
    patch_px: int = 14

    def __post_init__(self) -> None:
        if self.width % self.num_heads:
            raise ValueError(f"vision width {self.width} does not split into {self.num_heads} heads")
        if self.image_px % self.patch_px:
            raise ValueError(f"image of {self.image_px} px does not split into patches of {self.patch_px} px")

    @property
    def num_patches(self) -> int:
        return (self.image_px // self.patch_px) ** 2


class Float32LayerNorm(nn.LayerNorm):
    """LayerNorm whose parameters stay float32 while the stream may be bfloat16, as in openpi."""

    def __init__(self, width: int, eps: float = LAYER_NORM_EPS) -> None:
        super().__init__(width, eps=eps)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.float()).to(x.dtype)


class VisionAttention(nn.Module):
    """Self-attention among the patches of one image."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.num_heads = config.num_heads
        self.q_proj = nn.Linear(config.width, config.width)
        self.k_proj = nn.Linear(config.width, config.width)
        self.v_proj = nn.Linear(config.width, config.width)
        self.out_proj = nn.Linear(config.width, config.width)

    def forward(self, x_BSW: Tensor) -> Tensor:
        q_BhSD, k_BhSD, v_BhSD = (
            proj(x_BSW).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
            for proj in (self.q_proj, self.k_proj, self.v_proj)
        )
        mixed_BhSD = F.scaled_dot_product_attention(q_BhSD, k_BhSD, v_BhSD)
        out_BSW: Tensor = self.out_proj(mixed_BhSD.transpose(1, 2).flatten(2))
        return out_BSW


class VisionMlp(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.fc1 = nn.Linear(config.width, config.mlp_width)
        self.fc2 = nn.Linear(config.mlp_width, config.width)

    def forward(self, x_BSW: Tensor) -> Tensor:
        out_BSW: Tensor = self.fc2(F.gelu(self.fc1(x_BSW), approximate="tanh"))
        return out_BSW


class VisionLayer(nn.Module):
    """Pre-norm transformer layer with affine LayerNorms."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.layer_norm1 = Float32LayerNorm(config.width)
        self.self_attn = VisionAttention(config)
        self.layer_norm2 = Float32LayerNorm(config.width)
        self.mlp = VisionMlp(config)

    def forward(self, x_BSW: Tensor) -> Tensor:
        x_BSW = x_BSW + self.self_attn(self.layer_norm1(x_BSW))
        mlp_BSW: Tensor = self.mlp(self.layer_norm2(x_BSW))
        return x_BSW + mlp_BSW


class VisionTower(nn.Module):
    """Submodules have the public key names, so that `pi05.weights` renames whole prefixes only."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch_px, stride=config.patch_px)
        self.position_embedding = Embedding(config.num_patches, config.width)
        self.layers = Stack[VisionLayer](VisionLayer(config) for _ in range(config.depth))
        self.post_layernorm = Float32LayerNorm(config.width)

    def forward(self, images_B3PP: Tensor, stream_dtype: torch.dtype) -> Tensor:
        """(B, 3, P, P) float32 in [-1, 1] -> (B, S, W) after the last LayerNorm.

        Patch and position embeddings are added in float32; the layers run in ``stream_dtype``, their weights' dtype.
        """
        patches_BSW = self.patch_embedding(images_B3PP).flatten(2).transpose(1, 2)
        x_BSW = (patches_BSW + self.position_embedding.weight).to(stream_dtype)
        for layer in self.layers:
            x_BSW = layer(x_BSW)
        out_BSW: Tensor = self.post_layernorm(x_BSW)
        return out_BSW
