"""GR00T's two kinds of layers over packed weights and static buffers: Qwen3's, and blocks of attention with biases.

Qwen3 per layer: four GEMMs (q|k|v and gate|up are one each, and the second ends in its gate), head norms with rotation,
attention, two norms. A block: four GEMMs with their biases, attention, GELU, two norms.
"""

# B batch, T tokens of the run, R = B * T rows, S tokens that are read, W width, h/g query/key heads, D head dim

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.groot.blocks import BlockAttention, BlockConfig, MixerBlock
from dual_system.models.groot.dit import DitBlock
from dual_system.models.groot.qwen3 import PlainRmsNorm, Qwen3, Qwen3Config, Qwen3Layer
from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style
from dual_system.models.kernels.trial import Verdict
from dual_system.models.pi05.gemma import Rotation
from pounce_server.kernels.head_rope import HeadNorms
from pounce_server.operations import Operations, Samples, tried
from pounce_server.packed import Matrix


@dataclass(frozen=True, slots=True, eq=False)
class PackedQwen3Layer:
    """One layer's norms and matrices, (out, in) as in PyTorch."""

    before_attention: Style
    heads: HeadNorms
    before_mlp: Style
    qkv: Tensor
    attention_out: Tensor
    gate_up: Tensor
    down: Tensor

    @classmethod
    def of(cls, layer: Qwen3Layer, config: Qwen3Config) -> "PackedQwen3Layer":
        """Packs ``layer``, whose parameters become views, so that no weight is stored twice."""
        attention, mlp = layer.self_attn, layer.mlp
        return cls(
            before_attention=_style(layer.input_layernorm),
            heads=HeadNorms(
                _style(attention.q_norm).scale,
                _style(attention.k_norm).scale,
                config.num_heads,
                config.num_kv_heads,
                config.norm_eps,
            ),
            before_mlp=_style(layer.post_attention_layernorm),
            qkv=Matrix.of(attention.q_proj, attention.k_proj, attention.v_proj).weight,
            attention_out=attention.o_proj.weight.data,
            gate_up=Matrix.of(mlp.gate_proj, mlp.up_proj).weight,
            down=mlp.down_proj.weight.data,
        )


def _style(norm: PlainRmsNorm) -> Style:
    return Style(norm.weight.data.float(), eps=norm.eps)


class LanguageRun:
    """Static buffers of B * T tokens of the language model; the caller fills ``x``."""

    def __init__(self, config: Qwen3Config, batch_size: int, num_tokens: int, like: Tensor) -> None:
        """``like`` gives dtype and device."""
        num_rows = batch_size * num_tokens
        self.batch_size = batch_size
        self.x = like.new_zeros(num_rows, config.width)
        self.normed = torch.empty_like(self.x)
        self.branch = torch.empty_like(self.x)
        self.qkv = like.new_empty(num_rows, (config.num_heads + 2 * config.num_kv_heads) * config.head_dim)
        self.activated = like.new_empty(num_rows, config.mlp_width)
        positions_1T = torch.arange(num_tokens, device=like.device)[None]
        self.rotation = Rotation.at(positions_1T, config.head_dim, config.rope_base)


class LanguageStream:
    """The layers of the language model and its last norm, packed."""

    def __init__(self, language: Qwen3, operations: Operations) -> None:
        self.layers = [PackedQwen3Layer.of(layer, language.config) for layer in language.layers]
        self.last = _style(language.norm)
        self.do = operations

    def choose(self, samples: Samples, timer: Timer) -> list[Verdict]:
        """Leaves of its operations those that are right and faster than their twins."""
        self.do, verdicts = tried(self.do, samples, timer)
        return verdicts

    def __call__(self, run: LanguageRun) -> None:
        """Runs ``run.x`` through the layers, each token after those before it; the last norm is in ``run.normed``."""
        do = self.do
        residual: Residual | None = None
        for layer in self.layers:
            do.norm(run.x, run.normed, layer.before_attention, residual)
            do.product(run.normed, layer.qkv, run.qkv)
            do.head_rope(run.qkv, layer.heads, run.rotation)
            do.product(_causal(run.qkv, layer.heads, run.batch_size), layer.attention_out, run.branch)
            do.norm(run.x, run.normed, layer.before_mlp, Residual(run.branch))
            do.swiglu_product(do.product, do.swiglu, run.normed, layer.gate_up, run.activated)
            do.product(run.activated, layer.down, run.branch)
            residual = Residual(run.branch)
        do.norm(run.x, run.normed, self.last, residual)


def _causal(qkv: Tensor, heads: HeadNorms, batch_size: int) -> Tensor:
    """Mixed values (R, h * D). Without a mask torch's fused kernels know grouped heads; no token sees later padding."""
    size = len(heads.query_D)
    split = (heads.num_heads, heads.num_kv_heads, heads.num_kv_heads)
    q_BhTD, k_BgTD, v_BgTD = qkv.view(batch_size, -1, sum(split), size).transpose(1, 2).split(split, dim=1)
    return _rows(F.scaled_dot_product_attention(q_BhTD, k_BgTD, v_BgTD, is_causal=True, enable_gqa=True))


def _rows(mixed_BhTD: Tensor) -> Tensor:
    batch_size, num_heads, num_tokens, size = mixed_BhTD.shape
    return mixed_BhTD.transpose(1, 2).reshape(batch_size * num_tokens, num_heads * size)


@dataclass(frozen=True, slots=True, eq=False)
class PackedBlock:
    """One block's matrices with their biases."""

    inputs: Matrix
    """[q|k|v], or q of a block that reads the features."""
    out: Matrix
    up: Matrix
    down: Matrix

    @classmethod
    def of(cls, block: MixerBlock | DitBlock, *, reads_features: bool) -> "PackedBlock":
        """Packs ``block``, whose parameters become views, so that no weight is stored twice."""
        attention = block.attn1
        inputs = (attention.to_q,) if reads_features else (attention.to_q, attention.to_k, attention.to_v)
        return cls(Matrix.of(*inputs), Matrix.of(attention.to_out), Matrix.of(block.ff.up), Matrix.of(block.ff.down))


def keys_values_of(attentions: Iterable[BlockAttention]) -> Matrix:
    """Keys and values of several blocks that read the same features, as one matrix: k|v of the first, and so on."""
    return Matrix.of(*(projection for attention in attentions for projection in (attention.to_k, attention.to_v)))


class BlockRun:
    """Static buffers of B * T tokens of a stack of blocks; the caller fills ``x``."""

    def __init__(self, config: BlockConfig, batch_size: int, num_tokens: int, like: Tensor) -> None:
        """``like`` gives dtype and device."""
        num_rows = batch_size * num_tokens
        self.batch_size, self.head_dim = batch_size, config.head_dim
        self.x = like.new_zeros(num_rows, config.width)
        self.normed = torch.empty_like(self.x)
        self.branch = torch.empty_like(self.x)
        self.up = like.new_empty(num_rows, config.mlp_width)


class Read(NamedTuple):
    """What a block's tokens attend to: keys and values (B, h, S, D), their own if None; 0 or -inf as (B, 1, 1, S)."""

    keys_values: tuple[Tensor, Tensor] | None = None
    bias: Tensor | None = None


class BlockStream:
    """A stack of blocks, packed: GR00T's mixer, or its transformer."""

    def __init__(self, blocks: Iterable[PackedBlock], operations: Operations) -> None:
        self.blocks = list(blocks)
        self.do = operations

    def choose(self, samples: Samples, timer: Timer) -> list[Verdict]:
        """Leaves of its operations those that are right and faster than their twins."""
        self.do, verdicts = tried(self.do, samples, timer)
        return verdicts

    def __call__(self, run: BlockRun, styles: Sequence[Style], reads: Sequence[Read]) -> None:
        """Runs ``run.x`` through the blocks. ``styles`` are two per block; of the last block ``run.branch`` is left to
        be added to ``run.x``."""
        do = self.do
        residual: Residual | None = None
        for index, (block, read) in enumerate(zip(self.blocks, reads, strict=True)):
            do.norm(run.x, run.normed, styles[2 * index], residual)
            do.product(_mixed(do, run, block.inputs, read), block.out.weight, run.branch, block.out.bias)
            do.norm(run.x, run.normed, styles[2 * index + 1], Residual(run.branch))
            do.product(run.normed, block.up.weight, run.up, block.up.bias)
            do.product(F.gelu(run.up, approximate="tanh"), block.down.weight, run.branch, block.down.bias)
            residual = Residual(run.branch)


def _mixed(do: Operations, run: BlockRun, inputs: Matrix, read: Read) -> Tensor:
    """Mixed values (R, W)."""
    projected = run.normed.new_empty(len(run.normed), len(inputs.weight))
    do.product(run.normed, inputs.weight, projected, inputs.bias)
    parts = projected.view(run.batch_size, -1, projected.shape[1] // run.x.shape[1], run.x.shape[1]).unbind(2)
    q_BhTD, *own = (part.unflatten(-1, (-1, run.head_dim)).transpose(1, 2) for part in parts)
    keys, values = read.keys_values or own
    return _rows(F.scaled_dot_product_attention(q_BhTD, keys, values, attn_mask=read.bias))
