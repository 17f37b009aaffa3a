"""Options of ``ponder-serve``, and the engine that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ponder_server.context_policy import PolicyName
from ponder_server.contract import WeightsName
from protocol.options import LinkOptions

SizeName = Literal["tiny_cpu", "qwen35_0p8b", "qwen35_2b", "qwen35_4b", "qwen35_9b"]
"""Functions of ``dual_system.models.ponder.configs``."""

NUM_TORCH_THREADS = 1  # on a CPU one thread per process beats two: a contended second one costs more than it gives


@dataclass(frozen=True, slots=True, kw_only=True)
class PonderOptions:
    """PONDER (System 2): keeps the episode in Qwen3.5's causal context and answers queries with a cognition."""

    link: LinkOptions = field(default_factory=lambda: LinkOptions(listen=("tcp/127.0.0.1:7448",)))
    checkpoint: Path | None = None
    """Folder in the Hugging Face layout; none: random weights, which are no policy."""
    size: SizeName = "tiny_cpu"
    """Of the random network, if there is no checkpoint. It speaks the tiny vocabulary at every size."""
    seed: int = 0
    """Of the random weights, if there is no checkpoint."""
    device: str = "cpu"
    dtype: Literal["float32", "bfloat16"] = "float32"
    attention_threads: int = 1
    """That share a long context's attention on a CPU, as many as this process may use cores at most. The answers stay
    the same. By default 1: the next core is POUNCE's, whose deadlines are nearer."""
    max_context_tokens: int = 16_384
    """Per session (paper, section 3.4)."""
    when_full: PolicyName = "refuse"
    """Refuse the query; forget the oldest queries but not the demonstration; or forget old pictures, keep carriers."""
    max_sessions: int = 2
    max_text_tokens: int = 256
    other_robots: tuple[str, ...] = ()
    """Robots to serve beside --link.robot, with the same weights and in common forwards."""
    max_batch_rows: int = 8
    """Robots that share a forward at most. With 1, no device's answers depend on other robots in their last bits."""
    latency_budget_ms: int = 1000
    """With other robots: from a query to its cognition when all ask at once, with full contexts; an episode that
    breaks it is refused."""
    draft_texts: Path | None = None
    """File of example texts, one a line: texts like them are written several tokens a forward."""
    draft_tokens: int = 0
    """Tokens that the checkpoint's multi-token prediction guesses at a time where the examples have no guess, 15 at
    most. The texts stay the same ones."""
    weights: WeightsName = "float"
    """int8, on a CPU, and fp8: a byte a weight of the layers, a quarter of float32's memory; the change of cognition is
    measured at start and told. fp8 products are taken by GPUs that have them (compute capability 8.9), in bfloat16."""
    graphs: bool = True
    """On a GPU forwards are CUDA graphs, recorded at start. --no-graphs: as on a CPU, where there are none."""
