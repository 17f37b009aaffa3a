"""Arguments of every operation of a forward, to compare kernels with their twins on the card and with its weights.

# B rows, T tokens, R = B T, H hidden, G key heads of size D, P positions
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dual_system.models.fp8 import Fp8Linear
from dual_system.models.kernels.fp8 import FEW_ROWS, Quantised
from dual_system.models.kernels.rms_norm import Residual
from ponder_server.kernels.rotate_store import Projected, Window
from ponder_server.slots import Keep, SlotMemory
from ponder_server.stack import AttentionLayer, DeltaLayer, Stack


def rehearse(stack: Stack, memory: SlotMemory, *, num_rows: int, length: int) -> dict[str, tuple[Any, ...]]:
    """Arguments by operation: the first layers' weights, random numbers, contexts that end full; ``memory`` is kept."""
    device = stack.norm.scale.device
    generator = torch.Generator(device).manual_seed(0)

    def drawn(*shape: int, dtype: torch.dtype = stack.dtype) -> Tensor:
        return torch.randn(shape, generator=generator, device=device, dtype=dtype)

    num_positions = max(memory.max_tokens, length)
    rows = torch.arange(num_rows, device=device)
    window = Window(rows, torch.full_like(rows, num_positions - length), torch.full_like(rows, length))
    x_BTH = drawn(num_rows, length, len(stack.norm.scale))
    first = stack.layers[0]
    gate_BTM = first.gate(x_BTH)
    attention = next(layer.mixer for layer in stack.layers if isinstance(layer.mixer, AttentionLayer))
    delta = next(layer.mixer for layer in stack.layers if isinstance(layer.mixer, DeltaLayer))
    inputs_BTC, gate_BTX = delta.inputs(x_BTH), delta.gate(x_BTH)
    num_channels, width = delta.conv_CW.shape
    num_heads, key_dim, size = next(iter(memory.recurrent.values())).state.shape[1:]
    _, key_heads, _, head_size = next(iter(memory.attention.values())).keys.shape
    projected = Projected(*(product(x_BTH) for product in attention.inputs))
    query_heads = projected.query_gate_BTX.shape[-1] // (2 * head_size)
    keys, values = (drawn(num_rows, key_heads, num_positions, head_size) for _ in range(2))
    positions = torch.arange(length, device=device).expand(3, num_rows, -1)
    asking_BT = torch.arange(length, device=device).expand(num_rows, -1).contiguous()
    state_BVDE = drawn(num_rows, num_heads, key_dim, size, dtype=torch.float32)
    conv_BCW = drawn(num_rows, num_channels, width)
    kept = [Keep(torch.zeros_like(state), torch.full_like(rows, (length + 1) // 2)) for state in (conv_BCW, state_BVDE)]
    x_RH = x_BTH.flatten(0, 1)
    cos_sin = tuple(stack.rotary(x_BTH, positions))
    queries = drawn(num_rows, length, query_heads, head_size)
    norm = x_RH, torch.zeros_like(x_RH), first.input_norm, Residual(drawn(*x_RH.shape))
    narrow: dict[str, tuple[Any, ...]] = {}
    if stack.multiplies_fp8:
        assert isinstance(first.gate, Fp8Linear)
        blank = Quantised(*(part.zero_() for part in Quantised.blank(x_RH)))
        narrow = {"norm": (*norm, blank), "quantise": (gate_BTM.flatten(0, 1),)}
        if num_rows * length <= FEW_ROWS:
            narrow["few_rows"] = x_RH, first.gate.weight_OI, first.gate.scale_O
    return {
        "norm": norm,
        "swiglu": (gate_BTM, first.up(x_BTH)),
        "conv_silu": (inputs_BTC, delta.conv_CW, conv_BCW, rows, window.num_new_B, kept[0]),
        "delta": (
            *(inputs_BTC, delta.speed_beta(x_BTH), delta.a_log_V, delta.dt_bias_V),
            *(state_BVDE, rows, window.num_new_B, kept[1]),
        ),
        "gated_norm": (*(drawn(num_rows * length, num_heads, size), gate_BTX.flatten(0, 1), delta.norm_E, delta.eps),),
        "rotate_store": (projected, attention.norms, cos_sin, keys, values, window),
        "attend": (queries, projected.query_gate_BTX, keys, values, asking_BT, window, num_positions),
        **narrow,
    }
