"""A stream of pi0.5, prefix or actions, over packed weights and static buffers.

Per layer: four GEMMs (q|k|v and gate|up are one each), one attention, and four fused operations between them.
"""

# B batch, T tokens of the run, R = B * T rows, S slots of the cache, W width, M MLP width
# h/g query/key heads, D head dim

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style, norm_eager, norm_fused
from dual_system.models.kernels.trial import Verdict, choose
from dual_system.models.pi05.gemma import ExpertLayer, GemmaConfig, GemmaLayer, Rotation
from pounce_server.kernels.choice import product
from pounce_server.kernels.euler import euler_eager, euler_fused
from pounce_server.kernels.geglu import geglu_eager, geglu_fused
from pounce_server.kernels.rope import Slots, rope_eager, rope_fused


@dataclass(frozen=True, slots=True, kw_only=True)
class Operations:
    """One implementation of the GEMMs and of all operations between them."""

    norm: Callable[[Tensor, Tensor, Style, Residual | None], None]
    rope: Callable[[Tensor, Rotation, Tensor, Slots], None]
    geglu: Callable[[Tensor, Tensor], None]
    euler: Callable[[Tensor, Tensor, Tensor, int], None]
    product: Callable[[Tensor, Tensor, Tensor], None] = product


TWINS = Operations(norm=norm_eager, rope=rope_eager, geglu=geglu_eager, euler=euler_eager)
KERNELS = Operations(norm=norm_fused, rope=rope_fused, geglu=geglu_fused, euler=euler_fused)


@dataclass(frozen=True, slots=True, eq=False)
class Norm:
    """One norm of a stream: its style, and the gate of the residual that follows it."""

    style: Style
    gate: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PackedLayer:
    """One layer's matrices, (out, in) as in PyTorch."""

    qkv: Tensor
    attention_out: Tensor
    gate_up: Tensor
    down: Tensor

    @classmethod
    def of(cls, layer: GemmaLayer | ExpertLayer) -> "PackedLayer":
        """Packs ``layer``, whose parameters become views, so that no weight is stored twice."""
        attention, mlp = layer.self_attn, layer.mlp
        return cls(
            qkv=_joined(attention.q_proj, attention.k_proj, attention.v_proj),
            attention_out=attention.o_proj.weight.data,
            gate_up=_joined(mlp.gate_proj, mlp.up_proj),
            down=mlp.down_proj.weight.data,
        )


def _joined(*projections: nn.Linear) -> Tensor:
    joined = torch.cat([projection.weight.data for projection in projections])
    parts = joined.split([projection.out_features for projection in projections])
    for projection, part in zip(projections, parts, strict=True):
        projection.weight.data = part
    return joined


class Run:
    """Static buffers of T tokens that go through a stream together.

    The caller must fill ``x``, ``rotation`` and ``bias`` before running the stream.
    """

    def __init__(self, config: GemmaConfig, batch_size: int, num_tokens: int, seen: slice, like: Tensor) -> None:
        """``seen``: slots to which these tokens attend, their own the last; ``like`` gives dtype and device."""
        num_rows, device = batch_size * num_tokens, like.device
        head_dim, num_heads, num_kv_heads = config.head_dim, config.num_heads, config.num_kv_heads
        self.seen = seen
        self.first = seen.stop - num_tokens
        self.x = like.new_zeros(num_rows, config.width)
        self.normed = torch.empty_like(self.x)
        self.branch = torch.empty_like(self.x)
        self.qkv = like.new_empty(num_rows, (num_heads + 2 * num_kv_heads) * head_dim)
        self.queries = like.new_empty(batch_size, num_kv_heads, num_heads // num_kv_heads * num_tokens, head_dim)
        self.gate_up = like.new_empty(num_rows, 2 * config.mlp_width)
        self.activated = like.new_empty(num_rows, config.mlp_width)
        pairs = torch.zeros(batch_size, 1, num_tokens, head_dim // 2, device=device)
        self.rotation = Rotation(pairs, pairs.clone())
        self.bias = like.new_zeros(batch_size, 1, 1, seen.stop - seen.start)
        """0 for slots that are seen, else -inf; from a bool torch would make it again in every layer."""

    def attend(self, keys: Tensor, values: Tensor) -> Tensor:
        """The tokens' mixed values (R, h * D); with one key head nothing is copied, as a token's heads are rows."""
        (batch_size, groups, _, _), num_tokens = self.queries.shape, len(self.x) // len(self.queries)
        mixed = F.scaled_dot_product_attention(
            self.queries, keys[:, :, self.seen], values[:, :, self.seen], attn_mask=self.bias
        )
        return mixed.view(batch_size, groups, num_tokens, -1).transpose(1, 2).reshape(len(self.x), -1)

    def place(self, positions_BT: Tensor, visible_BS: Tensor) -> None:
        """Loads the tokens' positions, and which of the attended slots are real."""
        rotation = Rotation.at(positions_BT, 2 * self.rotation.cos.shape[-1])
        self.rotation.cos.copy_(rotation.cos)
        self.rotation.sin.copy_(rotation.sin)
        self.bias.zero_().masked_fill_(~visible_BS[:, None, None, :], float("-inf"))


class FusedStream:
    """The layers of one stream, packed."""

    def __init__(self, layers: Iterable[GemmaLayer | ExpertLayer], operations: Operations) -> None:
        self._layers = [PackedLayer.of(layer) for layer in layers]
        self.do = operations

    def choose(self, samples: dict[str, tuple[Any, ...]], timer: Timer) -> list[Verdict]:
        """Leaves of its operations those that are right and faster than their twins; see ``trial.choose``."""
        twins = replace(TWINS, product=self.do.product)
        self.do, verdicts = choose(samples, twins, self.do, timer)
        return verdicts

    def __call__(self, run: Run, norms: Sequence[Norm], cache: Sequence[tuple[Tensor, Tensor]]) -> None:
        """Runs ``run.x`` through the layers; keys and values go into ``cache``, the last norm into ``run.normed``.

        ``norms`` are two per layer and, for a stream whose output is used, the last. Without it the last layer
        computes only keys and values.
        """
        residual: Residual | None = None
        for index, (layer, (keys, values)) in enumerate(zip(self._layers, cache, strict=True)):
            before_attention, before_mlp = norms[2 * index : 2 * index + 2]
            self.do.norm(run.x, run.normed, before_attention.style, residual)
            self.do.product(run.normed, layer.qkv, run.qkv)
            self.do.rope(run.qkv, run.rotation, run.queries, Slots(keys, values, run.first))
            if index == len(self._layers) - 1 and len(norms) == 2 * len(self._layers):
                return
            self.do.product(run.attend(keys, values), layer.attention_out, run.branch)
            self.do.norm(run.x, run.normed, before_mlp.style, Residual(run.branch, before_attention.gate))
            self.do.product(run.normed, layer.gate_up, run.gate_up)
            self.do.geglu(run.gate_up, run.activated)
            self.do.product(run.activated, layer.down, run.branch)
            residual = Residual(run.branch, before_mlp.gate)
        self.do.norm(run.x, run.normed, norms[-1].style, residual)
