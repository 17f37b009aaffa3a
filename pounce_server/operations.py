"""What a fused network runs between its buffers: by eager twins, or in Triton.

A server takes a kernel only if it is right and faster on its card (``dual_system.models.kernels.trial``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from torch import Tensor

from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style, norm_eager, norm_fused
from dual_system.models.kernels.trial import Verdict, choose
from dual_system.models.pi05.gemma import Rotation
from pounce_server.kernels.attention import Rope, Seen, attend_eager, attend_fused
from pounce_server.kernels.choice import product
from pounce_server.kernels.euler import euler_eager, euler_fused
from pounce_server.kernels.gate import Gate, geglu_eager, geglu_fused, swiglu_eager, swiglu_fused
from pounce_server.kernels.gate_product import Product, gate_product_eager, geglu_product_fused, swiglu_product_fused
from pounce_server.kernels.head_rope import HeadNorms, head_rope_eager, head_rope_fused
from pounce_server.kernels.rope import Slots, rope_eager, rope_fused


@dataclass(frozen=True, slots=True, kw_only=True)
class Operations:
    """One implementation of the GEMMs and of all operations between them. Each family calls some of them."""

    norm: Callable[[Tensor, Tensor, Style, Residual | None], None]
    rope: Rope
    head_rope: Callable[[Tensor, HeadNorms, Rotation], None]
    geglu: Gate
    swiglu: Gate
    euler: Callable[[Tensor, Tensor, Tensor, int], None]
    attend: Callable[[Rope, Tensor, Rotation, Slots, Seen], Tensor]
    """Its twin is `rope` and torch's attention."""
    geglu_product: Callable[[Product, Gate, Tensor, Tensor, Tensor], None]
    """Its twin is `product` and `geglu`."""
    swiglu_product: Callable[[Product, Gate, Tensor, Tensor, Tensor], None]
    """Its twin is `product` and `swiglu`."""
    product: Product = product


TWINS = Operations(
    norm=norm_eager,
    rope=rope_eager,
    head_rope=head_rope_eager,
    geglu=geglu_eager,
    swiglu=swiglu_eager,
    euler=euler_eager,
    attend=attend_eager,
    geglu_product=gate_product_eager,
    swiglu_product=gate_product_eager,
)
KERNELS = Operations(
    norm=norm_fused,
    rope=rope_fused,
    head_rope=head_rope_fused,
    geglu=geglu_fused,
    swiglu=swiglu_fused,
    euler=euler_fused,
    attend=attend_fused,
    geglu_product=geglu_product_fused,
    swiglu_product=swiglu_product_fused,
)


class Samples(NamedTuple):
    """Arguments of a stream's operations, for a trial."""

    parts: dict[str, tuple[Any, ...]]
    wholes: Callable[[Operations], dict[str, tuple[Any, ...]]] = lambda parts: {}
    """Those of operations that replace several, given the parts that were taken: their twins are made of them."""


def tried(kernels: Operations, samples: Samples, timer: Timer) -> tuple[Operations, list[Verdict]]:
    """The ``kernels`` that are right and faster than their twins, and twins for the others; see ``trial.choose``.

    Products are not tried: those of ``kernels`` are kept.
    """
    parts, verdicts = choose(samples.parts, replace(TWINS, product=kernels.product), kernels, timer)
    operations, more = choose(samples.wholes(parts), parts, kernels, timer)
    return operations, verdicts + more
