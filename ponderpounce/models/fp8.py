"""fp8 weights (e4m3): a byte each, and on a GPU that has them fp8 products.

Each output row has its own scale, its largest weight / 448. Between powers of two there are eight steps, so a weight is
off by a sixteenth of itself at most; int8 is off by as much for every weight of a row, which is less for the large ones
and more for the small ones.

A GPU of compute capability 8.9 or more multiplies bfloat16 activations as fp8, each row of them with a scale of its
own, taken as it comes (``torch._scaled_mm``). Everywhere else weights are widened as a layer is called, as int8's are.
"""

# O output rows, I input columns, M rows of activations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

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


class Fp8Linear(nn.Module):
    """`nn.Linear` over fp8 weights. Its device must stay: it decides how products are taken."""

    weight_OI: Tensor
    scale_O: Tensor

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        exact_OI = linear.weight.detach().float()
        weight_OI, scale_O = _narrowed(exact_OI)
        self.register_buffer("weight_OI", weight_OI)
        self.register_buffer("scale_O", scale_O)
        self.bias = linear.bias
        is_even = all(size % _MULTIPLE == 0 for size in exact_OI.shape)
        self._multiplies = is_even and has_products(exact_OI.device)

    def forward(self, x: Tensor) -> Tensor:
        # Products come out in bfloat16: a float32 network has asked for more.
        if self._multiplies and x.dtype == torch.bfloat16:
            out = _product(x.flatten(0, -2), self.weight_OI, self.scale_O).unflatten(0, x.shape[:-1])
        else:
            out = F.linear(x, self.weight_OI.to(x.dtype)) * self.scale_O.to(x.dtype)
        return out if self.bias is None else out + self.bias.to(x.dtype)


def _narrowed(exact_RI: Tensor) -> tuple[Tensor, Tensor]:
    """Rows as fp8, and the scale of each (R) float32. What is not finite stays so."""
    scale_R = (exact_RI.abs().amax(dim=1) / _MOST).clamp(min=torch.finfo(torch.float32).tiny)
    # Beyond the largest number a conversion gives NaN, and the division may be rounded there.
    return (exact_RI / scale_R[:, None]).clamp(-_MOST, _MOST).to(torch.float8_e4m3fn), scale_R


def _product(x_MI: Tensor, weight_OI: Tensor, scale_O: Tensor) -> Tensor:
    """(M, O) in bfloat16. The second matrix is read by columns, as the weight lies."""
    narrow_MI, scale_M = _narrowed(x_MI.float())
    return torch._scaled_mm(
        narrow_MI, weight_OI.t(), scale_a=scale_M[:, None], scale_b=scale_O[None], out_dtype=torch.bfloat16
    )
