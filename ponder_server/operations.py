"""What happens between the matrix products of a captured forward: by eager twins, or in Triton.

A kernel that has never met a GPU must not hurt. So a server runs each beside its twin at warm-up, on the card, with the
layer's weights and at the forward's shape, and takes it only if it is right and faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, norm_eager, norm_fused
from ponder_server.kernels.attention import attend_eager, attend_fused
from ponder_server.kernels.conv_silu import conv_silu_eager, conv_silu_fused
from ponder_server.kernels.delta import delta_eager, delta_fused
from ponder_server.kernels.gated_norm import gated_norm_eager, gated_norm_fused
from ponder_server.kernels.rotate_store import rotate_store_eager, rotate_store_fused
from ponder_server.kernels.swiglu import swiglu_eager, swiglu_fused

Function = Callable[..., Any]

MOST_ERROR = {torch.float32: 1e-4, torch.bfloat16: 2e-2}
"""Largest relative L2 distance of a kernel that is taken. A twin rounds in other places, and chunks sum in another
order: in the interpreter they differ by up to 3e-7, and in bfloat16 by up to 3e-3 (attention not counted, which it
multiplies wrongly in bfloat16)."""


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


TWINS = Operations(
    norm=norm_eager,
    swiglu=swiglu_eager,
    conv_silu=conv_silu_eager,
    delta=delta_eager,
    gated_norm=gated_norm_eager,
    rotate_store=rotate_store_eager,
    attend=attend_eager,
)
KERNELS = Operations(
    norm=norm_fused,
    swiglu=swiglu_fused,
    conv_silu=conv_silu_fused,
    delta=delta_fused,
    gated_norm=gated_norm_fused,
    rotate_store=rotate_store_fused,
    attend=attend_fused,
)


class Verdict(NamedTuple):
    """Whether a kernel was taken, and why."""

    operation: str
    is_taken: bool
    why: str


def choose(samples: dict[str, tuple[Any, ...]], kernels: Operations, timer: Timer) -> tuple[Operations, list[Verdict]]:
    """The kernels that agree with their twins and are faster, and twins for the others; one verdict each.

    ``samples`` are arguments by operation. Every run gets a copy, and all that it changes is compared.
    """
    chosen, verdicts = TWINS, []
    for field in fields(Operations):
        name = field.name
        twin, kernel = getattr(TWINS, name), getattr(kernels, name)
        is_taken, why = _compare(twin, kernel, samples[name], timer)
        verdicts.append(Verdict(name, is_taken, why))
        if is_taken:
            chosen = replace(chosen, **{name: kernel})
    return chosen, verdicts


def _compare(twin: Function, kernel: Function, sample: tuple[Any, ...], timer: Timer) -> tuple[bool, str]:
    expected = _outcome(twin, sample)
    try:
        came = _outcome(kernel, sample)
    except Exception as failure:  # a compiler's or a driver's own; whatever it is, the twin runs
        return False, f"it does not run: {type(failure).__name__}: {failure}"[:300]
    errors = [_distance(*pair) for pair in zip(came, expected, strict=True)]
    error = next(filter(math.isnan, errors), max(errors))  # max alone passes over a NaN
    most = MOST_ERROR[next(tensor.dtype for tensor in _tensors(sample) if tensor.dtype in MOST_ERROR)]
    if not error <= most:
        return False, f"it differs from its twin by {error:.1e} (relative L2), at most {most:.0e}"
    copy = _copied(sample)
    kernel_time, twin_time = timer(lambda: kernel(*copy)), timer(lambda: twin(*copy))
    took = f"{1e3 * kernel_time:.0f} us, its twin {1e3 * twin_time:.0f}; it differs by {error:.1e}"
    return kernel_time < twin_time, took


def _outcome(function: Function, sample: tuple[Any, ...]) -> list[Tensor]:
    """What it returns, and its arguments after it."""
    copy = _copied(sample)
    result = function(*copy)
    return [*_tensors((result,)), *_tensors(copy)]


def _copied(value: Any) -> Any:
    if isinstance(value, Tensor):
        copy = torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=value.device)
        return copy.copy_(value)
    if isinstance(value, tuple):
        copies = [_copied(part) for part in value]
        return type(value)(*copies) if hasattr(value, "_fields") else tuple(copies)
    if isinstance(value, Residual):
        return replace(value, branch=_copied(value.branch))
    return value


def _tensors(values: tuple[Any, ...]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, tuple):
            yield from _tensors(value)


def _distance(came: Tensor, expected: Tensor) -> float:
    if not expected.is_floating_point():
        return 0.0 if torch.equal(came, expected) else float("inf")
    return float((came.float() - expected.float()).norm() / expected.float().norm().clamp_min(1e-12))
