"""Reading and writing checkpoints in a public layout: the code that both families share.

A layout is a table of names and a few peculiarities: stored tensors that are never used, a prefix that another
project's policy class adds. Our own tensors are in the same file under ``pounce_prefix.``.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from dual_system.models.stored_tensors import Shape, require_shapes

COGNITION = "pounce_prefix."
FRAME_MEMORY = "pounce_frame_memory."
POINTER = "pounce_pointer."


def write_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    save_file({name: tensor.contiguous().cpu() for name, tensor in tensors.items()}, path, metadata={"format": "pt"})


def renamed(name: str, table: Iterable[tuple[str, str]]) -> str:
    """Replaces the prefix of ``name`` by the first entry (ours, public) of ``table`` that matches.

    Raises:
        KeyError: no entry matches.
    """
    for ours, public in table:
        if name.startswith(ours):
            return public + name.removeprefix(ours)
    raise KeyError(f"no public name for parameter {name!r}")


def require_fit(model: nn.Module, found: Mapping[str, Shape], public_name: Callable[[str], str], source: str) -> bool:
    """Compares the shapes of tensors with public names with a model's; returns whether a cognition prefix is there.

    A public file has none, no frame memory and no pointer: the model then keeps its own parameters of these.

    Raises:
        WeightsError: a tensor is missing, unknown or of another shape.
    """
    expected = {public_name(name): tuple(parameter.shape) for name, parameter in model.state_dict().items()}
    absent = tuple(own for own in (COGNITION, FRAME_MEMORY, POINTER) if not any(name.startswith(own) for name in found))
    expected = {public: shape for public, shape in expected.items() if not public.startswith(absent)}
    require_shapes(expected, found, source)
    return COGNITION not in absent


def assign(model: nn.Module, found: Mapping[str, Tensor], public_name: Callable[[str], str], source: str) -> bool:
    """Loads tensors with public names into ``model``, float32 throughout; otherwise as `require_fit`."""
    shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
    has_prefix = require_fit(model, shapes, public_name, source)
    # Copied even if float32 already: tensors of a mapped file are unaligned, and CPU products of unaligned
    # weights differ in the last bit from those of the saved model.
    state = {
        name: found[public].to(torch.float32, copy=True)
        for name in model.state_dict()
        if (public := public_name(name)) in found
    }
    model.load_state_dict(state, strict=False, assign=True)
    return has_prefix
