"""int8 weights for the matrices of POUNCE's streams. Embeddings, norms and small projections stay (`precision`)."""

from dual_system.models.int8 import Int8Linear
from dual_system.models.narrow_linear import quantise_where
from dual_system.models.pounce.family import AnyPounce
from dual_system.models.pounce.precision import is_of_a_stream

_KEPT = "groot.dit.proj_out_2.weight"  # GR00T's action stream takes its dtype from it


def quantise(model: AnyPounce) -> int:
    """Replaces the streams' matrices in place; returns the number of bytes saved."""
    return quantise_where(model, lambda name: is_of_a_stream(name) and name != _KEPT, Int8Linear)
