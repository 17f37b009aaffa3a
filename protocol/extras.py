"""The extra of ponderpounce-server that brings a package which a command is missing."""

from __future__ import annotations

from protocol.version import DISTRIBUTION

EXTRA_OF = {
    "torch": "serve",
    "transformers": "serve",
    "tokenizers": "serve",
    "safetensors": "serve",
    "sentencepiece": "serve",
    "mujoco": "sim",
    "tqdm": "sim",
    "pyarrow": "data",
    "av": "data",
    "PIL": "data",
    "rerun": "replay",
    "websockets": "gateway",
    "msgpack": "gateway",
    "zmq": "groot",
    "h5py": "import",
    "huggingface_hub": "hub",
    "tensorboard": "train",
    "gymnasium": "gym",
    "triton": "kernels",
}
"""Top-level import name -> one extra that has it; docs/install.md lists the extras of each computer."""


def way_out(error: ModuleNotFoundError) -> str | None:
    """A sentence with the command that installs what is missing; None if no extra of ours brings it."""
    package = (error.name or "").partition(".")[0]
    if (extra := EXTRA_OF.get(package)) is None:
        return None
    first = "torch first (docs/install.md), then " if package == "torch" else ""
    return f"{package} is not installed: {first}pip install '{DISTRIBUTION}[{extra}]'"
