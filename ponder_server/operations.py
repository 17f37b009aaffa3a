"""What happens between the matrix products of a captured forward: by eager twins, or in Triton.

A server takes a kernel only if it is right and faster on its card (``dual_system.models.kernels.trial``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dual_system.models.kernels.fp8 import few_rows_eager, few_rows_fused, quantise_eager, quantise_fused
from dual_system.models.kernels.rms_norm import norm_eager, norm_fused
from ponder_server.kernels.attention import attend_eager, attend_fused
from ponder_server.kernels.conv_silu import conv_silu_eager, conv_silu_fused
from ponder_server.kernels.delta import delta_eager, delta_fused
from ponder_server.kernels.gated_norm import gated_norm_eager, gated_norm_fused
from ponder_server.kernels.rotate_store import rotate_store_eager, rotate_store_fused
from ponder_server.kernels.swiglu import swiglu_eager, swiglu_fused

Function = Callable[..., Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Operations:
    """One implementation of each operation; the arguments are those of the twins in ``ponder_server.kernels``."""

    norm: Function
    swiglu: Function
    conv_silu: Function
    delta: Function
    gated_norm: Function
    rotate_store: Function
    attend: Function
    quantise: Function
    """``quantise`` and ``few_rows`` are called where weights are fp8."""
    few_rows: Function


TWINS = Operations(
    norm=norm_eager,
    swiglu=swiglu_eager,
    conv_silu=conv_silu_eager,
    delta=delta_eager,
    gated_norm=gated_norm_eager,
    rotate_store=rotate_store_eager,
    attend=attend_eager,
    quantise=quantise_eager,
    few_rows=few_rows_eager,
)
KERNELS = Operations(
    norm=norm_fused,
    swiglu=swiglu_fused,
    conv_silu=conv_silu_fused,
    delta=delta_fused,
    gated_norm=gated_norm_fused,
    rotate_store=rotate_store_fused,
    attend=attend_fused,
    quantise=quantise_fused,
    few_rows=few_rows_fused,
)
