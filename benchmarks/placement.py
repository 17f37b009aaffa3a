"""How much memory PONDER and POUNCE need on a GPU, and how many contexts fit beside them: sums, nothing is allocated.

python -m benchmarks.placement

Weights and contexts are what the servers allocate. Activations and captured graphs come on top, and were not measured.
"""

from __future__ import annotations

import sys

import torch
from torch import nn

from dual_system.analysis.markdown import markdown
from dual_system.models.ponder import configs as ponders
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import groot_n1_5, pi05_base
from dual_system.models.pounce.family import blank_model
from dual_system.models.pounce.precision import cast_streams
from ponder_server.config import ContextOptions
from ponder_server.narrow import is_narrow
from ponder_server.runner import NUM_SAVED_STATES
from ponder_server.slots import slot_size

SIZES = {"0.8B": ponders.qwen35_0p8b, "2B": ponders.qwen35_2b, "4B": ponders.qwen35_4b, "9B": ponders.qwen35_9b}
POUNCES = {"π0.5": pi05_base, "GR00T N1.5": groot_n1_5}
CARDS_GB = {"24 GB": 24, "48 GB": 48, "H100, 80 GB": 80, "H200, 141 GB": 141}
FREE = 0.85
"""Part of a card that weights and contexts may take; the rest is for what is not counted."""


def weight_gb(model: nn.Module, *, is_fp8: bool = False) -> float:
    """Size of a model in bfloat16 on the meta device; with fp8, narrow matrices take a byte a number, a scale a row."""
    total = 0
    for name, each in model.named_parameters():
        narrow = is_fp8 and each.ndim == 2 and is_narrow("fp8", name)
        total += each.numel() + 4 * len(each) if narrow else each.numel() * each.element_size()
    return total / 1e9


def session_gb(ponder: Ponder, num_tokens: int) -> float:
    """Memory of one robot's context of ``num_tokens``, with its saved states."""
    size = slot_size(ponder.qwen.config.text_config, ponder.dtype)
    return (size.slot_bytes(num_tokens) + NUM_SAVED_STATES * size.state_bytes) / 1e9


def tables() -> str:
    """Both tables in Markdown."""
    num_tokens = ContextOptions().max_context_tokens
    hands = {name: weight_gb(cast_streams(blank_model(config()), "bfloat16")) for name, config in POUNCES.items()}
    sizes, robots = [], []
    for name, size in SIZES.items():
        ponder = Ponder.random(size(), seed=0, device="meta", dtype=torch.bfloat16)
        weights_gb = {"bfloat16": weight_gb(ponder.qwen), "fp8": weight_gb(ponder.qwen, is_fp8=True)}
        each_gb = session_gb(ponder, num_tokens)
        sizes.append([f"PONDER {name}", *(f"{gb:.1f}" for gb in weights_gb.values()), f"{each_gb:.2f}"])
        for where, beside_gb in {"beside π0.5": hands["π0.5"], "alone": 0.0}.items():
            for kind, own_gb in weights_gb.items():
                rooms_gb = (FREE * card - beside_gb - own_gb for card in CARDS_GB.values())
                robots.append([f"{name} in {kind}, {where}", *(str(max(0, int(room / each_gb))) for room in rooms_gb)])
    sizes += [[f"POUNCE {name}", f"{gb:.1f}", "", ""] for name, gb in hands.items()]
    head = ["GB", "weights, bfloat16", "weights, fp8", f"a context of {num_tokens:,} tokens"]
    largest = [row for row in robots if row[0].startswith(("4B", "9B"))]
    return f"{markdown(head, sizes)}\n\n{markdown(['contexts of this length that fit', *CARDS_GB], largest)}\n"


def main() -> int:
    sys.stdout.write(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
