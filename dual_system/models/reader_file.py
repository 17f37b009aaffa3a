"""reader.safetensors: the weights of a reader of demonstrations, whole or as what they differ by, in few bits.

Whole, every tensor of the reader has its name. Narrowed, the header says how many of its layers are stored (``layers``)
and in how many bits (``bits``); of every matrix NAME in them ``NAME.codes`` and ``NAME.steps`` tell what is to be added
to the language model's (`few_bits`), vectors are stored as they are, and all other layers are the language model's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from dual_system.models.few_bits import STEP_OF_STD, FewBits, narrowed, rounded, shape_of_codes, widened
from dual_system.models.reader import Reader

CODES, STEPS = ".codes", ".steps"
_LAYERS, _BITS = "layers", "bits"


@dataclass(frozen=True, slots=True, kw_only=True)
class Narrowing:
    """In what a reader may differ from the layers that it stands beside, and how finely."""

    num_layers: int
    """The first so many."""
    bits: int
    """Of every number of their matrices."""

    def __post_init__(self) -> None:
        if self.num_layers < 1:
            raise ValueError(f"a reader differs in at least one layer, came {self.num_layers}")
        if self.bits not in STEP_OF_STD:
            raise ValueError(f"{self.bits} bits: expected {', '.join(map(str, STEP_OF_STD))}")


def write_reader(reader: Reader, text_model: nn.Module, path: Path, narrowing: Narrowing | None = None) -> None:
    """Writes the file; with a ``narrowing``, what it differs by from the layers of ``text_model``."""
    metadata = {"format": "pt"}
    if narrowing is not None:
        metadata |= {_LAYERS: str(narrowing.num_layers), _BITS: str(narrowing.bits)}
    begun = _weights(text_model)
    tensors: dict[str, Tensor] = {}
    for name, weight in _stored(reader, narrowing).items():
        if narrowing is None:
            tensors[name] = weight.contiguous()
        elif weight.ndim == 1:
            tensors[name] = weight.half()
        else:
            difference = weight.float() - begun[name].float()
            tensors[name + CODES], tensors[name + STEPS] = narrowed(difference.cpu(), narrowing.bits)
    save_file(tensors, path, metadata=metadata)


def narrowing_of(file: Any) -> Narrowing | None:
    """Of an open file; None: it holds whole weights.

    Raises:
        ValueError: what its header says is none.
    """
    told = file.metadata() or {}
    if _LAYERS not in told and _BITS not in told:
        return None
    try:
        return Narrowing(num_layers=int(told[_LAYERS]), bits=int(told[_BITS]))
    except (KeyError, ValueError) as error:
        raise ValueError(f"its header says {told}, expected {_LAYERS} and {_BITS} ({error})") from error


def stored_shapes(reader: Reader, narrowing: Narrowing | None) -> dict[str, tuple[int, ...]]:
    """What a file of this reader holds, by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, weight in _stored(reader, narrowing).items():
        shape = tuple(weight.shape)
        if narrowing is None or weight.ndim == 1:
            shapes[name] = shape
        else:
            shapes |= {name + CODES: shape_of_codes(shape, narrowing.bits), name + STEPS: shape[:1]}
    return shapes


@torch.no_grad()
def read_weights(file: Any, reader: Reader, text_model: nn.Module, narrowing: Narrowing | None) -> None:
    """From an open file whose names and shapes are as they should be, into a reader that is like ``text_model``."""
    begun = _weights(text_model)
    for name, weight in _stored(reader, narrowing).items():
        if narrowing is None or weight.ndim == 1:
            weight.copy_(file.get_tensor(name))
        else:
            few = FewBits(file.get_tensor(name + CODES), file.get_tensor(name + STEPS))
            difference = widened(few, tuple(weight.shape), narrowing.bits).to(weight.device)
            weight.copy_(begun[name].float() + difference)


@torch.no_grad()
def confine(reader: Reader, text_model: nn.Module, narrowing: Narrowing) -> None:
    """Makes its other layers the language model's again; they learn no more."""
    begun, own = _weights(text_model), _stored(reader, narrowing)
    for name, weight in reader.named_parameters():
        if name not in own:
            weight.copy_(begun[name])
            weight.requires_grad_(False)


@contextmanager
def as_stored(reader: Reader, text_model: nn.Module, narrowing: Narrowing) -> Iterator[None]:
    """Within, its matrices are those that a file would give, with the gradient of their own."""
    replaced: list[tuple[nn.Module, str, nn.Parameter]] = []
    begun, own = _weights(text_model), _stored(reader, narrowing)
    for path, module in reader.named_modules():
        for name, weight in list(module.named_parameters(recurse=False)):
            full_name = f"{path}.{name}"
            if full_name in own and weight.ndim > 1:
                replaced.append((module, name, weight))
                base = begun[full_name]
                given: dict[str, Any] = module._parameters  # whatever stands here is the module's attribute
                given[name] = base + rounded(weight - base, narrowing.bits)
    try:
        yield
    finally:
        for module, name, weight in replaced:
            module._parameters[name] = weight


def _stored(reader: Reader, narrowing: Narrowing | None) -> dict[str, Tensor]:
    """Those of its weights that a file holds."""
    weights = _weights(reader)
    if narrowing is None:
        return weights
    others = tuple(f"layers.{index}." for index in range(narrowing.num_layers, len(reader.layers)))
    return {name: weight for name, weight in weights.items() if not name.startswith(others)}


def _weights(module: nn.Module) -> dict[str, Tensor]:
    return {name: weight.detach() for name, weight in module.named_parameters()}
