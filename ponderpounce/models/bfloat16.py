"""Whether this computer's processor gains by bfloat16, which some only pretend to have."""

import torch

HAS_FAST_BFLOAT16 = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
"""Of the CPU. Where it is not so, torch multiplies bfloat16 number by number: AVX2 alone, some twenty times slower."""


def warn_of_slow(dtype: str, device: str) -> str | None:
    """Returns what to tell somebody who asked for this precision on this device; None if there is nothing to say."""
    if dtype != "bfloat16" or device != "cpu" or HAS_FAST_BFLOAT16:
        return None
    return (
        "--dtype bfloat16: this CPU does not multiply it in hardware, and torch does so many times slower than "
        "float32. Leave --dtype out; where memory is short, servers have --weights int8"
    )
