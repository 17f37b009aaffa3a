"""Selects the parameters of POUNCE that are bfloat16 and those that stay float32 (openpi's choice)."""

from typing import Literal

import torch

from dual_system.models.pounce.family import AnyPounce

_STREAMS = (
    *("pi05.vision.", "pi05.projector.", "pi05.language.", "pi05.expert."),
    *("groot.eagle.", "groot.mixer.", "groot.dit.blocks.", "groot.dit.proj_out_2."),
)
_FLOAT32_PARTS = ("norm", "patch_embedding", "position_embedding")


def is_of_a_stream(name: str) -> bool:
    """Whether a parameter is a matrix of a stream, which may be narrow."""
    return name.startswith(_STREAMS) and not any(part in name for part in _FLOAT32_PARTS)


def cast_streams(model: AnyPounce, dtype: Literal["float32", "bfloat16"]) -> AnyPounce:
    """Casts ``model`` in place and returns it.

    In bfloat16 the streams' matrices are cast (two in pi0.5; Eagle, mixer and transformer in GR00T); norms
    (adaRMS and styled ones with their layers), pixel and position embeddings, state, action and time projections
    and the cognition prefix stay float32, and each norm computes in float32.
    """
    if dtype not in ("float32", "bfloat16"):
        raise ValueError(f"dtype must be 'float32' or 'bfloat16', came {dtype!r}")
    if dtype == "bfloat16":
        for name, parameter in model.named_parameters():
            if is_of_a_stream(name):
                parameter.data = parameter.data.to(torch.bfloat16)
    return model
