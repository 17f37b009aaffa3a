"""Qwen3.5's vision tower over many frames of one size at once.

transformers packs frames of any size into one long row and attends to each in a Python loop. Our frames have one size,
so the same modules run over a batch of frames with one attention product. The weights, their names and the result are
transformers' (a test compares them).
"""

# N frames, P patches of a frame (in blocks of m x m, as they are merged), C vision width, h heads, D head dim

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import torch
import torch.nn.functional as F
from torch import Tensor

_ROPE_BASE = 10_000.0
_rotations: WeakKeyDictionary[Any, dict[tuple[Any, ...], tuple[Tensor, Tensor]]] = WeakKeyDictionary()
"""Kept for each tower by grid and device: a tower that copied them to its GPU could not be captured."""


def image_tokens(tower: Any, patches: Tensor, grid: tuple[int, int]) -> Tensor:
    """Vision tokens (N * P / m^2, H) of N frames' patches (N * P, D).

    Args:
        tower: transformers' ``Qwen3_5VisionModel``.
        grid: rows and columns of a frame's patches.
    """
    rows, columns = grid
    merge, heads = int(tower.config.spatial_merge_size), int(tower.config.num_heads)
    embedding = tower.patch_embed.proj  # kernel size and stride are one patch: a matrix product
    x_NPC = F.linear(patches, embedding.weight.flatten(1), embedding.bias).unflatten(0, (-1, rows * columns))
    x_NPC = x_NPC + _position_embeddings(tower, rows, columns, merge).to(x_NPC.dtype)
    head_dim = x_NPC.shape[-1] // heads
    kept, key = _rotations.setdefault(tower, {}), (rows, columns, x_NPC.device)
    if key not in kept:
        kept[key] = _rotation(rows, columns, merge, head_dim, x_NPC.device)
    cos_PD, sin_PD = kept[key]
    for block in tower.blocks:
        qkv = block.attn.qkv(block.norm1(x_NPC)).unflatten(-1, (3, heads, head_dim))
        q_NhPD, k_NhPD, v_NhPD = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        q_NhPD, k_NhPD = (_rotated(t, cos_PD, sin_PD) for t in (q_NhPD, k_NhPD))
        x_NPC = x_NPC + block.attn.proj(_attended(q_NhPD, k_NhPD, v_NhPD).transpose(1, 2).flatten(2))
        x_NPC = x_NPC + block.mlp(block.norm2(x_NPC))
    tokens: Tensor = tower.merger(x_NPC.flatten(0, 1))
    return tokens


def _attended(q_NhPD: Tensor, k_NhPD: Tensor, v_NhPD: Tensor) -> Tensor:
    if q_NhPD.device.type != "cpu":
        return F.scaled_dot_product_attention(q_NhPD, k_NhPD, v_NhPD)
    # On a CPU the fused kernel's backward pass takes several times as long as two plain products.
    weights = (q_NhPD @ k_NhPD.transpose(-1, -2) * q_NhPD.shape[-1] ** -0.5).softmax(dim=-1, dtype=torch.float32)
    return weights.to(v_NhPD.dtype) @ v_NhPD


def _rotated(x_NhPD: Tensor, cos_PD: Tensor, sin_PD: Tensor) -> Tensor:
    first, second = x_NhPD.float().chunk(2, dim=-1)
    return (x_NhPD * cos_PD + torch.cat([-second, first], dim=-1) * sin_PD).to(x_NhPD.dtype)


def _position_embeddings(tower: Any, rows: int, columns: int, merge: int) -> Tensor:
    """(P, C): the learned square table, sampled bilinearly from corner to corner."""
    table = tower.pos_embed.weight
    side = int(table.shape[0] ** 0.5)
    table_SSC = table.float().unflatten(0, (side, side))
    for dim, count in ((0, rows), (1, columns)):
        if count != side:
            places = torch.linspace(0, side - 1, count, device=table.device)
            low = places.long().clamp(max=max(side - 2, 0))
            share = (places - low).view(-1, *(1,) * (2 - dim))
            high = (low + 1).clamp(max=side - 1)
            table_SSC = table_SSC.index_select(dim, low) * (1 - share) + table_SSC.index_select(dim, high) * share
    return _in_blocks(table_SSC, merge)


@torch.inference_mode(False)  # the kept tensors may later be used with autograd
def _rotation(rows: int, columns: int, merge: int, head_dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosines and sines (P, D): the first half of the frequencies encodes the row, the second the column."""
    spatial = head_dim // 2
    frequencies = 1.0 / _ROPE_BASE ** (torch.arange(0, spatial, 2, dtype=torch.float32, device=device) / spatial)
    axes = (torch.arange(count, device=device) for count in (rows, columns))
    places = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    angles = (_in_blocks(places, merge)[..., None] * frequencies).flatten(1)
    angles = torch.cat([angles, angles], dim=-1)
    return angles.cos(), angles.sin()


def _in_blocks(grid_RCX: Tensor, merge: int) -> Tensor:
    """(rows, columns, X) -> (P, X), in the order of the patches."""
    rows, columns, _ = grid_RCX.shape
    blocks = grid_RCX.unflatten(1, (columns // merge, merge)).unflatten(0, (rows // merge, merge))
    return blocks.transpose(1, 2).flatten(0, 3)
