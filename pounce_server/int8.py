"""Which of POUNCE's matrices are int8: the streams'. Embeddings, norms, small projections stay, as in `precision`."""

from dual_system.models.int8 import Int8Linear
from dual_system.models.narrow_linear import quantise_where
from dual_system.models.pounce.family import AnyPounce
from pounce_server.precision import is_of_a_stream

_KEPT = "groot.dit.proj_out_2.weight"  # tells GR00T's action stream in which type it runs


def quantise(model: AnyPounce) -> int:
    """Replaces the streams' matrices in place; returns how many bytes that saved."""
    return quantise_where(model, lambda name: is_of_a_stream(name) and name != _KEPT, Int8Linear)
