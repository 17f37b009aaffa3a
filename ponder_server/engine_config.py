"""How an engine serves: limits of its contexts, what shares a forward, and what the weights are kept as."""

from __future__ import annotations

from dataclasses import dataclass

from ponder_server.context_policy import PolicyName
from ponder_server.contract import WeightsName
from ponder_server.runner import BUCKETS


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineConfig:
    """How an engine serves; what it serves is in its ``Ponder``."""

    num_cameras: int = 2
    """Frames per fire, always the same cameras in the same order."""
    max_context_tokens: int = 16_384
    """Per session (paper, section 3.4: 16K holds 100 fires of two cameras and more)."""
    max_sessions: int = 4
    """Contexts held at once; all of them are allocated when the engine is built."""
    when_full: PolicyName = "refuse"
    """See ``context_policy``."""
    max_text_tokens: int = 256
    """Limit of one text. A text that reaches it is closed as it is and flagged ``truncated``."""
    prefill_chunk_tokens: int = 2048
    """Opening tokens per forward: more is faster, fewer lets ``progress`` be heard more often."""
    max_batch_rows: int = 8
    """Sessions that share a forward at most."""
    max_prefixes: int = 2
    """Demonstrations kept encoded for further episodes that begin with the same one."""
    buckets: tuple[int, ...] = BUCKETS
    """Lengths that a forward's rows are padded to, growing."""
    attention_threads: int = 1
    """That share a long context's attention on a CPU. No bit of an answer depends on them."""
    weights: WeightsName = "float"
    """int8, fp8: a byte a weight of the layers; the change of cognition is measured when the engine is built."""
    graphs: bool = True
    """On a GPU forwards are CUDA graphs (``captured``)."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            least = 0 if name == "max_prefixes" else 1
            if type(value) is int and value < least:
                raise ValueError(f"{name} is {value}; it must be at least {least}.")
        if not self.buckets or self.buckets[0] < 1 or list(self.buckets) != sorted(set(self.buckets)):
            raise ValueError(f"buckets are {self.buckets}; they must be at least 1 and grow.")
