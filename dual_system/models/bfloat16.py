"""Whether this machine's CPU multiplies bfloat16 in hardware; torch emulates it on the others."""

import torch

HAS_FAST_BFLOAT16 = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
"""False on CPUs with AVX2 alone, where torch emulates bfloat16 products at about a twentieth of the speed."""


def warn_of_slow(dtype: str, device: str, option: str = "--dtype") -> str | None:
    """Returns a warning for a user who chose this precision by ``option`` on this device; None if it is fast."""
    if dtype != "bfloat16" or device != "cpu" or HAS_FAST_BFLOAT16:
        return None
    return (
        f"{option} bfloat16: this CPU does not multiply it in hardware, and torch does so many times slower than "
        f"float32. Leave {option} out; where memory is short, servers have --weights int8"
    )
