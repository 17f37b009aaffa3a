"""fp8 weights (e4m3): a byte each, and on a GPU that has them fp8 products.

Each output row has its own scale, its largest weight / 448. Between powers of two there are eight steps, so a weight is
off by a sixteenth of itself at most; int8 is off by as much for every weight of a row, which is less for the large ones
and more for the small ones.

A GPU of compute capability 8.9 or more multiplies bfloat16 activations as fp8, each row of them with a scale of its
own, taken as it comes (``torch._scaled_mm``). Everywhere else weights are widened as a layer is called, as int8's are.
"""

# O output rows, R rows of either matrix, I input columns, M rows of activations

import torch
from torch import Tensor, nn

from dual_system.models.narrow_linear import NarrowLinear, row_scale

LEAST_CAPABILITY = (8, 9)
"""Ada and Hopper: the first with fp8 products."""
_MOST = 448.0
_MULTIPLE = 16
"""Of rows and columns, in fp8 products."""


def missing_for(device: torch.device) -> str:
    """Why there can be no fp8 weights on ``device``, for a person; empty if there can."""
    if not hasattr(torch, "float8_e4m3fn"):
        return f"torch {torch.__version__} has no float8_e4m3fn"
    if device.type not in ("cpu", "cuda"):
        return f"fp8 weights are for a CPU or a CUDA GPU, not for {device.type!r}"
    return ""


def has_products(device: torch.device) -> bool:
    """Whether ``device`` multiplies fp8, and this torch can ask it to."""
    if device.type != "cuda" or not hasattr(torch, "_scaled_mm"):
        return False
    return torch.cuda.get_device_capability(device) >= LEAST_CAPABILITY


class Fp8Linear(NarrowLinear):
    """`nn.Linear` over fp8 weights. Its device must stay: it decides how products are taken."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__(linear)
        is_even = all(size % _MULTIPLE == 0 for size in linear.weight.shape)
        self._multiplies = is_even and has_products(linear.weight.device)

    @staticmethod
    def narrowed(exact_RI: Tensor) -> tuple[Tensor, Tensor]:
        """As `NarrowLinear`'s. What is not finite stays so."""
        scale_R = row_scale(exact_RI, _MOST)
        # Beyond the largest number a conversion gives NaN, and the division may be rounded there.
        return (exact_RI / scale_R[:, None]).clamp(-_MOST, _MOST).to(torch.float8_e4m3fn), scale_R

    def product(self, x: Tensor) -> Tensor:
        # Products come out in bfloat16: a float32 network has asked for more.
        if self._multiplies and x.dtype == torch.bfloat16:
            return _product(x.flatten(0, -2), self.weight_OI, self.scale_O).unflatten(0, x.shape[:-1])
        return super().product(x)


def _product(x_MI: Tensor, weight_OI: Tensor, scale_O: Tensor) -> Tensor:
    """(M, O) in bfloat16. The second matrix is read by columns, as the weight lies."""
    narrow_MI, scale_M = Fp8Linear.narrowed(x_MI.float())
    return torch._scaled_mm(
        narrow_MI, weight_OI.t(), scale_a=scale_M[:, None], scale_b=scale_O[None], out_dtype=torch.bfloat16
    )
