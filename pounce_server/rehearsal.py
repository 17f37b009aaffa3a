"""Arguments of a stream's operations, to compare kernels with their twins on the card and at its shape."""

from __future__ import annotations

import torch
from torch import Tensor

from dual_system.models.kernels.rms_norm import Residual, Style
from pounce_server.fused_stream import Norm, Run
from pounce_server.groot_stream import BlockRun, LanguageRun, PackedQwen3Layer
from pounce_server.kernels.rope import Slots, empty_queries
from pounce_server.operations import Samples

NAN = float("nan")


def rehearse(run: Run, norm: Norm, keys: Tensor, values: Tensor, gate_up: Tensor) -> Samples:
    """Random numbers in ``run``'s buffers and in the slots, a third of which is hidden, and NaN where a kernel must
    write all. ``gate_up``: a layer's weights."""
    generator = torch.Generator(run.x.device).manual_seed(0)
    for read in (run.x, run.branch, run.qkv, run.rotation.cos, run.rotation.sin, keys, values):
        read.normal_(generator=generator)
    visible = torch.ones_like(run.seen.bias[:, 0, 0], dtype=torch.bool)
    visible[:, : visible.shape[1] // 3] = False
    run.seen.place(visible, len(run.x) // len(visible))
    slots = Slots(keys, values, run.first)
    queries = empty_queries(run.qkv, slots)
    for written in (run.normed, queries, run.activated):
        written.fill_(NAN)
    gate_and_up = run.x.new_empty(len(run.x), len(gate_up)).normal_(generator=generator)
    return Samples(
        parts={
            "norm": (run.x, run.normed, norm.style, Residual(run.branch, norm.gate)),
            "rope": (run.qkv, run.rotation, queries, slots),
            "geglu": (gate_and_up, run.activated),
        },
        wholes=lambda parts: {
            "attend": (parts.rope, run.qkv, run.rotation, slots, run.seen),
            "geglu_product": (parts.product, parts.geglu, run.x, gate_up, run.activated),
        },
    )


def rehearse_language(run: LanguageRun, layer: PackedQwen3Layer) -> Samples:
    """The same for a layer of GR00T's language model."""
    generator = torch.Generator(run.x.device).manual_seed(0)
    for read in (run.x, run.branch, run.qkv):
        read.normal_(generator=generator)
    for written in (run.normed, run.activated):
        written.fill_(NAN)
    gate_and_up = run.x.new_empty(len(run.x), len(layer.gate_up)).normal_(generator=generator)
    return Samples(
        parts={
            "norm": (run.x, run.normed, layer.before_mlp, Residual(run.branch)),
            "head_rope": (run.qkv, layer.heads, run.rotation),
            "swiglu": (gate_and_up, run.activated),
        },
        wholes=lambda parts: {
            "swiglu_product": (parts.product, parts.swiglu, run.x, layer.gate_up, run.activated),
        },
    )


def rehearse_blocks(run: BlockRun, style: Style) -> Samples:
    """The same for blocks of GR00T's action head."""
    generator = torch.Generator(run.x.device).manual_seed(0)
    for read in (run.x, run.branch):
        read.normal_(generator=generator)
    run.normed.fill_(NAN)
    return Samples(parts={"norm": (run.x, run.normed, style, Residual(run.branch))})
