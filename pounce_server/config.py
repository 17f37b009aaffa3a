"""Options of ``pounce-serve``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from protocol.options import DaemonOptions, LinkOptions
from protocol.sockets import endpoint

PathName = Literal["eager", "compile", "max-autotune", "fused"]

NUM_TORCH_THREADS = 1  # on a CPU one thread per process beats two: contention for the second core costs more


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomOptions:
    """The network without --checkpoint."""

    family: Literal["pi05", "groot"] | None = None
    """Action model of the random weights; None: pi05. With --checkpoint, the family that the folder must hold."""
    num_carriers: int = 1
    """K of the random weights; must equal PONDER's."""
    hidden_size: int | None = None
    """H of the random weights; must equal PONDER's. None: the tiny PONDER's."""
    seed: int = 0
    """Seed of the random weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedOptions:
    """How an invocation is computed."""

    path: PathName = "eager"
    """compile, max-autotune: torch.compile, for either family; takes a minute at start. fused: Triton kernels, static
    buffers and CUDA graphs, for either family; needs a GPU and Triton."""
    autotune: bool = False
    """With --path fused: time cuBLAS against cuBLASLt for every product, once per GPU; the choice is stored in the
    user's cache folder."""
    weights: Literal["float", "int8"] = "float"
    """Precision of the weights. int8: a quarter of the memory on a CPU; the error of the actions is measured at start
    and logged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContinuityOptions:
    """Continuity between a chunk and the one being played."""

    continuity: Literal["none", "rtc", "trained"] = "none"
    """Whether pi0.5 continues the rows being played. rtc: real-time chunking, which costs a backward pass per flow
    step. trained: free, but needs a checkpoint trained for it (`pp-train --max-committed-rows`)."""
    roll_forward: bool = False
    """Plan from the predicted state after the committed rows instead of the measured one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteOptions:
    """Another project's policy server in place of the network, for the other backends than own and official."""

    url: str | None = None
    """Address of the policy server: ws://HOST:PORT or wss://..., with a path if it has one (openpi, vla-eval);
    tcp://HOST:PORT (GR00T); tcp/HOST:PORT#DEPLOYMENT (LeRobot)."""
    mapping: Path | None = None
    """TOML file with the policy's names, units and rate for the robot's cameras, state and commands, see
    docs/policies.md."""
    key_file: Path | None = None
    """File with the word that the policy server wants: openpi's Api-Key, GR00T's api_token."""
    answer_s: float = 5.0
    """Longest time for an answer in seconds. After it the connection is made anew; the robot plays the rows it has,
    then holds."""
    start_s: float = 600.0
    """Longest wait in seconds for the server and its first answer: a policy may compile for minutes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotsOptions:
    """Serving several robots with one network."""

    other_robots: tuple[str, ...] = ()
    """Further robots to serve; they share the weights with --link.robot. An episode with which a robot's rows could
    come too late for its schedule is refused."""
    max_batch_rows: int = 8
    """Largest number of robots in one batch. With 1, no robot's rows depend on the others in their last bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PounceOptions:
    """POUNCE (System 1): turns an observation, a cognition and its age into a chunk of 20 rows."""

    checkpoint: Path | None = None
    """Folder with config.json and model.safetensors: ours, openpi's or lerobot's pi0.5, NVIDIA's or lerobot's GR00T
    N1.5. None: random weights, which are no policy."""
    tokenizer: Path | None = None
    """tokenizer.model (pi0.5) or tokenizer.json (GR00T), if the checkpoint folder has none."""
    backend: Literal["own", "official", "openpi", "vla-eval", "groot", "groot-n1.5", "lerobot"] = "own"
    """Code that runs the network. official: the official PonderPounce package, in whose environment this then runs;
    --checkpoint is its folder, and of the other options --device and --link apply. The others ask a policy server at
    --url by --mapping: openpi (also SGLang's and vLLM-Omni's), vla-eval 0.8's, GR00T N1.6's and N1.7's, or N1.5's,
    LeRobot's."""
    device: str = "cpu"
    """Device of the network: cpu, cuda or cuda:N."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of weights and activations."""
    shadow: bool = False
    """Answer what the running POUNCE is asked, for the log only: nothing of it is used. See docs/operations.md."""
    link: LinkOptions = field(default_factory=lambda: LinkOptions(listen=(endpoint("pounce"),)))
    operations: tyro.conf.OmitArgPrefixes[DaemonOptions] = field(default_factory=DaemonOptions)
    speed: tyro.conf.OmitArgPrefixes[SpeedOptions] = field(default_factory=SpeedOptions)
    remote: tyro.conf.OmitArgPrefixes[RemoteOptions] = field(default_factory=RemoteOptions)
    chunks: tyro.conf.OmitArgPrefixes[ContinuityOptions] = field(default_factory=ContinuityOptions)
    robots: tyro.conf.OmitArgPrefixes[RobotsOptions] = field(default_factory=RobotsOptions)
    random: tyro.conf.OmitArgPrefixes[RandomOptions] = field(default_factory=RandomOptions)
