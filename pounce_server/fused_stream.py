"""A stream of pi0.5, prefix or actions, over packed weights and static buffers.

Per layer: four GEMMs (q|k|v and gate|up are one each, and the second ends in its gate), one attention with its
rotation, and two norms.
"""

# B batch, T tokens of the run, R = B * T rows, S slots of the cache, W width, M MLP width
# h/g query/key heads, D head dim

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style, norm_eager, norm_fused
from dual_system.models.kernels.trial import Verdict, choose
from dual_system.models.pi05.gemma import ExpertLayer, GemmaConfig, GemmaLayer, Rotation
from pounce_server.kernels.attention import Rope, Seen, attend_eager, attend_fused
from pounce_server.kernels.choice import product
from pounce_server.kernels.euler import euler_eager, euler_fused
from pounce_server.kernels.geglu import geglu_eager, geglu_fused
from pounce_server.kernels.geglu_product import Geglu, Product, geglu_product_eager, geglu_product_fused
from pounce_server.kernels.rope import Slots, empty_queries, rope_eager, rope_fused


@dataclass(frozen=True, slots=True, kw_only=True)
class Operations:
    """One implementation of the GEMMs and of all operations between them."""

    norm: Callable[[Tensor, Tensor, Style, Residual | None], None]
    rope: Rope
    geglu: Geglu
    euler: Callable[[Tensor, Tensor, Tensor, int], None]
    attend: Callable[[Rope, Tensor, Rotation, Slots, Seen], Tensor]
    """Its twin is `rope` and torch's attention."""
    geglu_product: Callable[[Product, Geglu, Tensor, Tensor, Tensor], None]
    """Its twin is `product` and `geglu`."""
    product: Product = product


TWINS = Operations(
    norm=norm_eager,
    rope=rope_eager,
    geglu=geglu_eager,
    euler=euler_eager,
    attend=attend_eager,
    geglu_product=geglu_product_eager,
)
KERNELS = Operations(
    norm=norm_fused,
    rope=rope_fused,
    geglu=geglu_fused,
    euler=euler_fused,
    attend=attend_fused,
    geglu_product=geglu_product_fused,
)


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


class Samples(NamedTuple):
    """Arguments of a stream's operations, for a trial."""

    parts: dict[str, tuple[Any, ...]]
    attend: tuple[Any, ...]
    """Without the rotation that was taken."""
    geglu_product: tuple[Any, ...]
    """Without the product and the gate that were taken."""


class FusedStream:
    """The layers of one stream, packed."""

    def __init__(self, layers: Iterable[GemmaLayer | ExpertLayer], operations: Operations) -> None:
        self.layers = [PackedLayer.of(layer) for layer in layers]
        self.do = operations

    def choose(self, samples: Samples, timer: Timer) -> list[Verdict]:
        """Leaves of its operations those that are right and faster than their twins; see ``trial.choose``.

        The twin of a whole is made of the parts that were taken.
        """
        twins, kernels = replace(TWINS, product=self.do.product), self.do
        parts, verdicts = choose(samples.parts, twins, kernels, timer)
        wholes = {
            "attend": (parts.rope, *samples.attend),
            "geglu_product": (parts.product, parts.geglu, *samples.geglu_product),
        }
        self.do, more = choose(wholes, parts, kernels, timer)
        return verdicts + more

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
