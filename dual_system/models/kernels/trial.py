"""Whether a kernel is taken: tried beside its eager twin on the card, at warm-up.

A kernel that has never met this GPU must not hurt. So a server runs both, with a layer's weights and at the forward's
shape, and takes the kernel only if it is right and faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Timer

Function = Callable[..., Any]
Operations = TypeVar("Operations")

MOST_ERROR = {torch.float32: 1e-4, torch.bfloat16: 2e-2}
"""Largest relative L2 distance of a kernel that is taken. A twin rounds in other places, and chunks sum in another
order: in the interpreter they differ by up to 3e-7, and in bfloat16 by up to 3e-3 (attention not counted, which it
multiplies wrongly in bfloat16)."""
_MOST_TOLD = 100
"""Characters of a reason in `told`."""


class Verdict(NamedTuple):
    """Whether a kernel was taken, and why."""

    operation: str
    is_taken: bool
    why: str


def choose(
    samples: Mapping[str, tuple[Any, ...]], twins: Operations, kernels: Operations, timer: Timer
) -> tuple[Operations, list[Verdict]]:
    """The kernels that agree with their twins and are faster, and twins for the others; one verdict each.

    ``samples`` are arguments by operation, a field of both dataclasses. Every run gets a copy, and all that it changes
    is compared.
    """
    chosen, verdicts = twins, []
    for name, sample in samples.items():
        kernel = getattr(kernels, name)
        is_taken, why = _compare(getattr(twins, name), kernel, sample, timer)
        verdicts.append(Verdict(name, is_taken, why))
        if is_taken:
            chosen = replace(chosen, **{name: kernel})  # type: ignore[type-var]
    return chosen, verdicts


def told(tried: Mapping[str, Sequence[Verdict]]) -> str:
    """A line: for every operation, at how many shapes its kernel was taken, and the first reason why not; or "".

    ``tried`` are verdicts by shape: "kernels: norm 5/5, swiglu 4/5 (1x1: 4.1 us, its twin 3.0; it differs by 2.0e-03)".
    """
    parts = []
    for name in dict.fromkeys(one.operation for verdicts in tried.values() for one in verdicts):
        here = [(shape, one) for shape, verdicts in tried.items() for one in verdicts if one.operation == name]
        part = f"{name} {sum(one.is_taken for _, one in here)}/{len(here)}"
        why_not = next((f" ({shape}: {one.why[:_MOST_TOLD]})" for shape, one in here if not one.is_taken), "")
        parts.append(part + why_not)
    return f"kernels: {', '.join(parts)}" if parts else ""


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
    try:
        kernel_time = timer(lambda: kernel(*copy))
    except Exception as failure:  # servers run it in graphs alone
        return False, f"it cannot be captured: {type(failure).__name__}: {failure}"[:300]
    try:
        twin_time = timer(lambda: twin(*copy))
    except Exception as failure:
        return True, f"its twin cannot be captured: {type(failure).__name__}: {failure}"[:300]
    took = f"{1e3 * kernel_time:.1f} us, its twin {1e3 * twin_time:.1f}; it differs by {error:.1e}"
    return kernel_time < twin_time, took


def _outcome(function: Function, sample: tuple[Any, ...]) -> list[Tensor]:
    """What it returns, and its arguments after it."""
    copy = _copied(sample)
    result = function(*copy)
    return [*_tensors(result), *_tensors(copy)]


def _copied(value: Any) -> Any:
    if isinstance(value, Tensor):
        copy = torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=value.device)
        return copy.copy_(value)
    if isinstance(value, tuple):
        copies = [_copied(part) for part in value]
        return type(value)(*copies) if hasattr(value, "_fields") else tuple(copies)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _copied(getattr(value, field.name)) for field in fields(value)})
    return value


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _tensors(part)
    elif is_dataclass(value):
        for field in fields(value):
            yield from _tensors(getattr(value, field.name))


def _distance(came: Tensor, expected: Tensor) -> float:
    if torch.equal(came, expected):  # infinities too, which a mask may hold
        return 0.0
    if not expected.is_floating_point():
        return float("inf")
    return float((came.float() - expected.float()).norm() / expected.float().norm().clamp_min(1e-12))
