"""Whether this computer's processor gains by bfloat16, which some only pretend to have."""

import torch

HAS_FAST_BFLOAT16 = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
"""Of the CPU. Where it is not so, torch multiplies bfloat16 number by number: AVX2 alone, some twenty times slower."""


def warn_of_slow(dtype: str, device: str, option: str = "--dtype") -> str | None:
    """Returns what to tell somebody who asked for this precision by this option on this device; None: nothing."""
    if dtype != "bfloat16" or device != "cpu" or HAS_FAST_BFLOAT16:
        return None
    return (
        f"{option} bfloat16: this CPU does not multiply it in hardware, and torch does so many times slower than "
        f"float32. Leave {option} out; where memory is short, servers have --weights int8"
    )
