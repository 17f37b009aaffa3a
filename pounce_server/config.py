"""Options of ``pounce-serve``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from protocol.options import LinkOptions

NUM_TORCH_THREADS = 1  # on a CPU one thread per process beats two: a contended second one costs more than it gives


@dataclass(frozen=True, slots=True, kw_only=True)
class PounceOptions:
    """POUNCE (System 1): turns an observation, a cognition and its age into a chunk of 20 rows."""

    link: LinkOptions = field(default_factory=lambda: LinkOptions(listen=("tcp/127.0.0.1:7449",)))
    checkpoint: Path | None = None
    """Folder with config.json and model.safetensors: ours, openpi's or lerobot's pi0.5, NVIDIA's or lerobot's GR00T
    N1.5; none: random weights."""
    family: Literal["pi05", "groot"] | None = None
    """Action model of the random weights, pi0.5 by default; a checkpoint knows its own, and must be this one."""
    tokenizer: Path | None = None
    """tokenizer.model (pi0.5) or tokenizer.json (GR00T), if the checkpoint folder has none."""
    seed: int = 0
    """Of the random weights, if there is no checkpoint."""
    num_carriers: int = 1
    """K of the random weights; must be PONDER's."""
    hidden_size: int | None = None
    """H of the random weights; must be PONDER's. Default: the tiny PONDER's."""
    device: str = "cpu"
    path: Literal["eager", "compile", "max-autotune", "fused"] = "eager"
    """compile, max-autotune: torch.compile, for either family, a minute at start. fused: Triton kernels, static buffers
    and CUDA graphs for pi0.5; needs a GPU and Triton."""
    autotune: bool = False
    """fused: time cuBLAS against cuBLASLt for every product, once for a GPU; kept in the user's cache folder."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    weights: Literal["float", "int8"] = "float"
    """int8: a quarter of the memory on a CPU; the error of the actions is measured at start and told."""
    continuity: Literal["none", "rtc", "trained"] = "none"
    """Whether pi0.5 continues the rows that are being played. rtc: real-time chunking, for a backward pass per flow
    step; trained: at no cost, by a checkpoint that learned to (`pp-train --max-committed-rows`)."""
    roll_forward: bool = False
    """Plan from the state that the committed rows lead to instead of the measured one."""
