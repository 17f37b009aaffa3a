"""FrameSamp+Modul's consumer: in every layer of the expert a memory scales and shifts the input of the FFN.

After a layer's joint attention and its residual, a = MemAttn(norm(h), norm(memory)) and (scale, shift) = Dense(a); the
FFN's branch reads m = (1 + scale) * norm(h) + shift, and its result is added to h, not to m. The branch begins with a
norm that is blind to the length of m, so m is given here times rms(h): with Dense and the norm's weight at zero, their
initial values, it is h bit for bit, and the network is pi0.5. All of it is float32.
"""

# B batch, F frames, C tokens of a frame, S = F * C tokens of the memory, P position size, W width of a feature
# N action tokens, E expert width, h/g query/key heads, D head dim

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.frame_sampling import FrameMemoryConfig
from dual_system.models.pi05.gemma import RMS_NORM_EPS, Attention, GemmaConfig, RmsNorm, Rotation, attend
from dual_system.models.stack import Stack

STEP_BASE = 1e4
PLACE_BASE = 1e3
_ENCODER_STD = 0.02
NO_FRAME = -1
"""Step of an empty slot."""


def positions(step_BF: Tensor, *, grid_side: int, pooled_side: int, size: int) -> Tensor:
    """Returns (B, F, C, P) float32: sines and cosines of step, y and x; a place is its centre, in patches."""
    batch_size, num_frames = step_BF.shape
    centres = (torch.arange(pooled_side, device=step_BF.device, dtype=torch.float64) + 0.5) * grid_side / pooled_side
    y_C, x_C = (each.flatten() for each in torch.meshgrid(centres, centres, indexing="ij"))
    shape = (batch_size, num_frames, pooled_side**2)
    step, y, x = (each.expand(shape) for each in (step_BF.double()[..., None], y_C, x_C))
    exponent = torch.arange(size // 6, device=step_BF.device, dtype=torch.float64) / (size // 6 - 1)
    blocks = []
    for values, base in ((step, STEP_BASE), (y, PLACE_BASE), (x, PLACE_BASE)):
        angle = values[..., None] * base**-exponent
        blocks += [angle.sin(), angle.cos()]
    return torch.cat(blocks, dim=-1).float()


def pooled(features_FSW: Tensor, pooled_side: int) -> Tensor:
    """Averages the patches of each picture, row by row, to (F, C, W) float32."""
    grid_side = round(features_FSW.shape[1] ** 0.5)
    grid_FWyx = features_FSW.float().transpose(1, 2).unflatten(2, (grid_side, grid_side))
    return F.avg_pool2d(grid_FWyx, grid_side // pooled_side).flatten(2).transpose(1, 2)


class Modulation(nn.Module):
    """One layer's reading of the memory."""

    def __init__(self, config: FrameMemoryConfig, width: int) -> None:
        super().__init__()
        heads = GemmaConfig(width=width, depth=1, mlp_width=1, num_heads=config.num_heads, head_dim=config.head_dim)
        self.norm = RmsNorm(width)
        self.attn = Attention(heads)
        self.dense = nn.Linear(width, 2 * width)

    def keys(self, memory_BSE: Tensor, rotation: Rotation) -> tuple[Tensor, Tensor]:
        """Returns the memory's rotated keys and its values, (B, g, S, D)."""
        _, k_BgSD, v_BgSD = self.attn.qkv(self.norm(memory_BSE), rotation)
        return k_BgSD, v_BgSD

    def forward(self, x_BNE: Tensor, k_BgSD: Tensor, v_BgSD: Tensor, visible_BS: Tensor) -> Tensor:
        """Returns m * rms(h), the input of the FFN's branch."""
        h_BNE = x_BNE.float()
        places_N = torch.arange(x_BNE.shape[1], device=x_BNE.device) + k_BgSD.shape[2]
        q_BhND, _, _ = self.attn.qkv(self.norm(h_BNE), Rotation.at(places_N[None], self.attn.head_dim))
        read_BNE = self.attn.o_proj(attend(q_BhND, k_BgSD, v_BgSD, visible_BS[:, None, None]))
        scale_BNE, shift_BNE = self.dense(read_BNE).chunk(2, dim=-1)
        rms_BN1 = (h_BNE.square().mean(dim=-1, keepdim=True) + RMS_NORM_EPS).sqrt()
        m_BNE = (1 + scale_BNE) * (1 + self.norm.weight) * h_BNE + rms_BN1 * shift_BNE
        return m_BNE.to(x_BNE.dtype)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemoryCache:
    """Every layer's keys and values of one memory, for all flow steps."""

    layers: Sequence[Modulation]
    keys: tuple[Tensor, ...]
    """(B, g, S, D) per layer."""
    values: tuple[Tensor, ...]
    visible: Tensor
    """(B, S) bool"""

    def modulated(self, layer: int, x_BNE: Tensor) -> Tensor:
        """The FFN branch's input in a layer of the expert."""
        out_BNE: Tensor = self.layers[layer](x_BNE, self.keys[layer], self.values[layer], self.visible)
        return out_BNE

    def repeated(self, times: int) -> "MemoryCache":
        """As `PrefixCache.repeated`."""
        return MemoryCache(
            layers=self.layers,
            keys=tuple(key.repeat(times, 1, 1, 1) for key in self.keys),
            values=tuple(value.repeat(times, 1, 1, 1) for value in self.values),
            visible=self.visible.repeat(times, 1),
        )


class FrameMemory(nn.Module):
    """Encodes past pictures' features to memory tokens, and reads them in every layer."""

    def __init__(self, config: FrameMemoryConfig, *, num_patches: int, feature_width: int, expert: GemmaConfig) -> None:
        super().__init__()
        self.config = config
        self.grid_side = config.grid_side(num_patches)
        self.position = nn.Linear(config.position_size, config.position_size)
        self.encoder = nn.Linear(config.position_size + feature_width, expert.width)
        self.null_memory = nn.Parameter(torch.empty(expert.width))
        self.layers = Stack[Modulation](Modulation(config, expert.width) for _ in range(expert.depth))

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draws fresh weights; every Dense and the null are zero, so that the network is pi0.5 at first."""
        for name, parameter in self.named_parameters():
            if parameter.dim() == 1 or ".dense." in name:
                parameter.zero_()
            else:
                std = parameter.shape[1] ** -0.5 if name.startswith("layers.") else _ENCODER_STD
                parameter.normal_(std=std, generator=generator)

    def tokens(self, features_BFCW: Tensor, step_BF: Tensor) -> tuple[Tensor, Tensor]:
        """Memory tokens (B, S, E), and which of them are visible (B, S).

        A sample without a frame has the learned null as its only token.

        Args:
            features_BFCW: features of every frame (`pooled`); those of empty slots are not read.
            step_BF: int64 step of every frame, or `NO_FRAME`.
        """
        where_BFCP = positions(
            step_BF, grid_side=self.grid_side, pooled_side=self.config.pooled_side, size=self.config.position_size
        )
        encoded_BFCP = F.silu(self.position(where_BFCP))
        memory_BSE = self.encoder(torch.cat([encoded_BFCP, features_BFCW], dim=-1)).flatten(1, 2)
        visible_BS = (step_BF != NO_FRAME).repeat_interleave(self.config.tokens_per_frame, dim=1)
        is_null_BS = torch.zeros_like(visible_BS)
        is_null_BS[:, 0] = ~visible_BS.any(dim=1)
        return torch.where(is_null_BS[..., None], self.null_memory, memory_BSE), visible_BS | is_null_BS

    def forward(self, features_BFCW: Tensor, step_BF: Tensor) -> MemoryCache:
        memory_BSE, visible_BS = self.tokens(features_BFCW, step_BF)
        places_S = torch.arange(memory_BSE.shape[1], device=memory_BSE.device)
        rotation = Rotation.at(places_S[None], self.config.head_dim)
        pairs = [layer.keys(memory_BSE, rotation) for layer in self.layers]
        return MemoryCache(
            layers=tuple(self.layers),
            keys=tuple(keys for keys, _ in pairs),
            values=tuple(values for _, values in pairs),
            visible=visible_BS,
        )
