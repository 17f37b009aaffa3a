"""Options of ``ponder-serve``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from ponder_server.contract import PolicyName, WeightsName
from protocol.command_line import On
from protocol.options import DaemonOptions, LinkOptions
from protocol.sockets import endpoint

SizeName = Literal["tiny_cpu", "qwen35_0p8b", "qwen35_2b", "qwen35_4b", "qwen35_9b"]
"""Names of functions in ``dual_system.models.ponder.configs``."""

NUM_TORCH_THREADS = 1  # on a CPU one thread per process beats two: contention for the second core costs more


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomOptions:
    """The network without --checkpoint."""

    size: SizeName = "tiny_cpu"
    """Size of the random network. It has the tiny vocabulary at every size."""
    seed: int = 0
    """Seed of the random weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContextOptions:
    """Limits and contents of a session's context."""

    max_context_tokens: int = 16_384
    """Most tokens of one session (paper, section 3.4)."""
    when_full: PolicyName = "refuse"
    """Refuse the query; forget the oldest queries but not the demonstration; or forget old pictures and keep texts
    and carriers."""
    max_text_tokens: int = 256
    """Most tokens of one subgoal or demonstration reasoning."""
    demo_hz: Literal[1, 2, 4, 5, 10, 20] | None = None
    """Frames per second of demonstrations that PONDER asks for. None: as in its training (paper: 1)."""
    demo_to_its_end: bool = False
    """Ask for the last frame of demonstrations as well, even if training did not use it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedOptions:
    """Speed and memory; texts and cognitions stay the same up to rounding."""

    weights: WeightsName = "float"
    """Precision of the layers' weights. int8 (CPU) and fp8 (CPU or CUDA GPU) take one byte each; the change of
    cognition is measured at start and logged. fp8 products need a GPU of compute capability 8.9 or more."""
    graphs: On = True
    """Do not record forwards as CUDA graphs at start, on a GPU."""
    kernels: On = True
    """Do not try Triton kernels in them; each is taken only where it is right and faster."""
    attention_threads: int = 1
    """Threads for long-context attention on a CPU; at most the number of usable cores. The answers stay the same. 1
    leaves the other cores to POUNCE, whose deadlines are shorter."""
    draft_texts: Path | None = None
    """File of example texts, one per line: similar texts are decoded several tokens per forward."""
    draft_tokens: int = 0
    """Tokens per draft of the checkpoint's multi-token prediction, where the examples have no draft; at most 15."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotsOptions:
    """Serving several robots with one network."""

    other_robots: tuple[str, ...] = ()
    """Further robots to serve; they share the weights with --link.robot and are batched together. An episode with which
    a robot's cognition could grow older than its --max-age-ms is refused."""
    max_sessions: int | None = None
    """Largest number of open contexts; their memory is allocated at start. None: two, or one for each robot if they are
    more."""
    max_batch_rows: int = 8
    """Largest number of robots in one forward. With 1, no robot's answer depends on the others in its last bits."""

    @property
    def num_sessions(self) -> int:
        """Contexts to allocate. Raises ValueError if there are more robots."""
        num_robots = 1 + len(self.other_robots)
        if self.max_sessions is not None and self.max_sessions < num_robots:
            raise ValueError(f"{num_robots} robots need as many sessions: --max-sessions is {self.max_sessions}.")
        return max(2, num_robots) if self.max_sessions is None else self.max_sessions


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatOptions:
    """A chat model in place of the network, for --backend openai."""

    url: str | None = None
    """Address of an endpoint with OpenAI's chat completions and pictures, up to the version: http://HOST:PORT/v1."""
    model: str | None = None
    """Name of the model at that endpoint."""
    ask: Path | None = None
    """TOML file with what the model is told, shown and allowed to answer, see docs/planners.md."""
    key_variable: str | None = None
    """Environment variable with the endpoint's key, e.g. OPENAI_API_KEY. None: no key is sent. It is never logged."""
    answer_s: float = 4.0
    """Longest time for a reply in seconds. A later one is no transition: the subgoal in force stays."""
    start_s: float = 60.0
    """Longest wait in seconds for the endpoint and its first answer: a model may still be loading."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PonderOptions:
    """PONDER (System 2): keeps the episode in Qwen3.5's causal context and answers queries with a cognition."""

    checkpoint: Path | None = None
    """Folder in the Hugging Face layout. None: random weights, which are no policy."""
    backend: Literal["own", "official", "openai"] = "own"
    """Code that runs the network. official: the official PonderPounce package, in whose environment this then runs;
    --checkpoint is its folder, and of the other options --device and --link apply. openai: a chat model at --url, asked
    for the next subgoal as --ask says; POUNCE must then read text."""
    device: str = "cpu"
    """Device of the network: cpu, cuda or cuda:N."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of weights and activations."""
    shadow: bool = False
    """Answer what the running PONDER is asked, for the log only: nothing of it is used. See docs/operations.md."""
    link: LinkOptions = field(default_factory=lambda: LinkOptions(listen=(endpoint("ponder"),)))
    operations: tyro.conf.OmitArgPrefixes[DaemonOptions] = field(default_factory=DaemonOptions)
    context: tyro.conf.OmitArgPrefixes[ContextOptions] = field(default_factory=ContextOptions)
    speed: tyro.conf.OmitArgPrefixes[SpeedOptions] = field(default_factory=SpeedOptions)
    chat: tyro.conf.OmitArgPrefixes[ChatOptions] = field(default_factory=ChatOptions)
    robots: tyro.conf.OmitArgPrefixes[RobotsOptions] = field(default_factory=RobotsOptions)
    random: tyro.conf.OmitArgPrefixes[RandomOptions] = field(default_factory=RandomOptions)
