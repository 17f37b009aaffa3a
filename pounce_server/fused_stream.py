"""A stream of pi0.5, prefix or actions, over packed weights and static buffers.

Per layer: four GEMMs (q|k|v and gate|up are one each, and the second ends in its gate), one attention with its
rotation, and two norms.
"""

# B batch, T tokens of the run, R = B * T rows, S slots of the cache, W width, M MLP width
# h/g query/key heads, D head dim

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style
from dual_system.models.kernels.trial import Verdict
from dual_system.models.pi05.gemma import ExpertLayer, GemmaConfig, GemmaLayer, Rotation
from pounce_server.kernels.attention import Seen
from pounce_server.kernels.rope import Slots, empty_queries
from pounce_server.operations import Operations, Samples, tried
from pounce_server.packed import Matrix


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
            qkv=Matrix.of(attention.q_proj, attention.k_proj, attention.v_proj).weight,
            attention_out=attention.o_proj.weight.data,
            gate_up=Matrix.of(mlp.gate_proj, mlp.up_proj).weight,
            down=mlp.down_proj.weight.data,
        )


class Run:
    """Static buffers of T tokens that go through a stream together.

    The caller must fill ``x``, ``rotation`` and ``seen`` before running the stream.
    """

    def __init__(self, config: GemmaConfig, batch_size: int, num_tokens: int, seen: slice, like: Tensor) -> None:
        """``seen``: slots to which these tokens attend, their own the last; ``like`` gives dtype and device."""
        num_rows, device = batch_size * num_tokens, like.device
        head_dim, num_heads, num_kv_heads = config.head_dim, config.num_heads, config.num_kv_heads
        self.seen = Seen.blank(seen, num_tokens, batch_size, like)
        self.first = seen.stop - num_tokens
        self.x = like.new_zeros(num_rows, config.width)
        self.normed = torch.empty_like(self.x)
        self.branch = torch.empty_like(self.x)
        self.qkv = like.new_empty(num_rows, (num_heads + 2 * num_kv_heads) * head_dim)
        self.activated = like.new_empty(num_rows, config.mlp_width)
        pairs = torch.zeros(batch_size, 1, num_tokens, head_dim // 2, device=device)
        self.rotation = Rotation(pairs, pairs.clone())

    def place(self, positions_BT: Tensor, visible_BS: Tensor) -> None:
        """Loads the tokens' positions, and which of the attended slots are real."""
        rotation = Rotation.at(positions_BT, 2 * self.rotation.cos.shape[-1])
        self.rotation.cos.copy_(rotation.cos)
        self.rotation.sin.copy_(rotation.sin)
        self.seen.place(visible_BS, positions_BT.shape[1])


class FusedStream:
    """The layers of one stream, packed."""

    def __init__(self, layers: Iterable[GemmaLayer | ExpertLayer], operations: Operations) -> None:
        self.layers = [PackedLayer.of(layer) for layer in layers]
        self.do = operations

    def choose(self, samples: Samples, timer: Timer) -> list[Verdict]:
        """Leaves of its operations those that are right and faster than their twins."""
        self.do, verdicts = tried(self.do, samples, timer)
        return verdicts

    def __call__(self, run: Run, norms: Sequence[Norm], cache: Sequence[tuple[Tensor, Tensor]]) -> None:
        """Runs ``run.x`` through the layers; keys and values go into ``cache``, the last norm into ``run.normed``.

        ``norms`` are two per layer and, for a stream whose output is used, the last. Without it the last layer
        computes only keys and values.
        """
        residual: Residual | None = None
        for index, (layer, (keys, values)) in enumerate(zip(self.layers, cache, strict=True)):
            before_attention, before_mlp = norms[2 * index : 2 * index + 2]
            self.do.norm(run.x, run.normed, before_attention.style, residual)
            self.do.product(run.normed, layer.qkv, run.qkv)
            slots = Slots(keys, values, run.first)
            if index == len(self.layers) - 1 and len(norms) == 2 * len(self.layers):
                self.do.rope(run.qkv, run.rotation, empty_queries(run.qkv, slots), slots)
                return
            mixed = self.do.attend(self.do.rope, run.qkv, run.rotation, slots, run.seen)
            self.do.product(mixed, layer.attention_out, run.branch)
            self.do.norm(run.x, run.normed, before_mlp.style, Residual(run.branch, before_attention.gate))
            self.do.geglu_product(self.do.product, self.do.geglu, run.normed, layer.gate_up, run.activated)
            self.do.product(run.activated, layer.down, run.branch)
            residual = Residual(run.branch, before_mlp.gate)
        self.do.norm(run.x, run.normed, norms[-1].style, residual)
