"""Options of an engine: limits of its contexts, batching, and the weights' precision."""

from __future__ import annotations

from dataclasses import dataclass

from ponder_server.contract import PolicyName, WeightsName
from ponder_server.runner import BUCKETS


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineConfig:
    """Options of an engine; the network is in its ``Ponder``."""

    num_cameras: int | None = None
    """Frames per fire, always the same cameras in the same order. None: as many as the checkpoint says."""
    max_context_tokens: int = 16_384
    """Limit per session (paper, section 3.4: 16K holds more than 100 fires of two cameras)."""
    max_sessions: int = 4
    """Largest number of open contexts; all of them are allocated when the engine is built."""
    when_full: PolicyName = "refuse"
    """See ``context_policy``."""
    max_text_tokens: int = 256
    """Limit of one text. A text that reaches it is cut and flagged ``truncated``."""
    prefill_chunk_tokens: int = 2048
    """Opening tokens per forward: more is faster, fewer calls ``progress`` more often."""
    max_batch_rows: int = 8
    """Largest number of sessions that share a forward."""
    max_prefixes: int = 2
    """Number of encoded openings to keep for further episodes with the same one."""
    buckets: tuple[int, ...] = BUCKETS
    """Lengths, in ascending order, to which a forward's rows are padded."""
    attention_threads: int = 1
    """Threads for long-context attention on a CPU; answers are bit-identical for any number."""
    weights: WeightsName = "float"
    """int8, fp8: one byte per layer weight; the change of cognition is measured when the engine is built."""
    graphs: bool = True
    """Run forwards as CUDA graphs on a GPU (``captured``)."""
    kernels: bool = True
    """In graphs, take Triton kernels where they are right and faster on this GPU (``operations``)."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            least = 0 if name == "max_prefixes" else 1
            if type(value) is int and value < least:
                raise ValueError(f"{name} is {value}; it must be at least {least}.")
        if not self.buckets or self.buckets[0] < 1 or list(self.buckets) != sorted(set(self.buckets)):
            raise ValueError(f"buckets are {self.buckets}; they must be at least 1 and grow.")
