"""fp8 weights (e4m3), one byte each; products are fp8 too on a GPU that supports them.

Each output row has its own scale, its largest weight / 448. e4m3 has eight steps between powers of two, so a weight's
relative error is at most 1/16. int8's absolute error is the same for every weight of a row: smaller than fp8's for the
large ones, larger for the small ones.

On a GPU of compute capability 8.9 or more, bfloat16 activations are quantised to fp8 as well, with one dynamic scale
per row (``torch._scaled_mm``), by the layer, or before it by whoever has the rows at hand (``kernels.fp8``). Everywhere
else weights are widened when a layer is called, as int8's are.
"""

# O output rows, R rows of either matrix, I input columns, M rows of activations

import torch
from torch import Tensor, nn

from dual_system.models.kernels.fp8 import Quantised, quantise_eager
from dual_system.models.narrow_linear import NarrowLinear

LEAST_CAPABILITY = (8, 9)
"""Ada and Hopper: the first GPUs with fp8 products."""
_MULTIPLE = 16
"""``torch._scaled_mm`` requires multiples of this many rows and columns."""


def missing_for(device: torch.device) -> str:
    """Why ``device`` cannot hold fp8 weights, for an error message; empty if it can."""
    if not hasattr(torch, "float8_e4m3fn"):
        return f"torch {torch.__version__} has no float8_e4m3fn"
    if device.type not in ("cpu", "cuda"):
        return f"fp8 weights are for a CPU or a CUDA GPU, not for {device.type!r}"
    return ""


def has_products(device: torch.device) -> bool:
    """Whether ``device`` and this torch support fp8 products."""
    if device.type != "cuda" or not hasattr(torch, "_scaled_mm"):
        return False
    return torch.cuda.get_device_capability(device) >= LEAST_CAPABILITY


class Fp8Linear(NarrowLinear):
    """`nn.Linear` over fp8 weights. Do not move it: the kind of product is chosen for its first device.

    Attributes:
        multiplies: whether the product of bfloat16 rows is an fp8 product.
    """

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__(linear)
        is_even = all(size % _MULTIPLE == 0 for size in linear.weight.shape)
        self.multiplies = is_even and has_products(linear.weight.device)

    @staticmethod
    def narrowed(exact_RI: Tensor) -> tuple[Tensor, Tensor]:
        """See `NarrowLinear.narrowed`."""
        return quantise_eager(exact_RI)

    def product(self, x: Tensor) -> Tensor:
        # fp8 products return bfloat16, less precision than a float32 network asks for.
        if self.multiplies and x.dtype == torch.bfloat16:
            rows = quantise_eager(x.flatten(0, -2))
            return self.product_of(rows).unflatten(0, x.shape[:-1])
        return super().product(x)

    def product_of(self, rows: Quantised) -> Tensor:
        """The fp8 product without the bias, (M, O) bfloat16, where the layer ``multiplies``."""
        return torch._scaled_mm(
            rows.narrow_MI,
            self.weight_OI.t(),  # it wants its second matrix column-major
            scale_a=rows.scale_M[:, None],
            scale_b=self.scale_O[None],
            out_dtype=torch.bfloat16,
            # Without it Hopper is much slower (pytorch#147971), and the numbers were rounded to a sixteenth before.
            use_fast_accum=True,
        )
