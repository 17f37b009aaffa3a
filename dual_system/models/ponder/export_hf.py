"""``pp-export hf``: writes trained models as public folders, and verifies them by reading them back.

    PONDER          transformers' Qwen3.5 folder; ponder.json, which other software ignores, says what PONDER adds
    POUNCE, pi0.5   openpi's PyTorch names, or lerobot's; float32
    POUNCE, GR00T   NVIDIA's folder: its names, and the config.json with all that tensor shapes do not show

No public layout has a place for the cognition prefix: it goes into ``pounce_prefix.safetensors``, which other software
ignores. The robot's statistics are not part of these folders either; they stay with the checkpoint.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from dual_system.models.groot import weights as groot_weights
from dual_system.models.groot.folder import groot_config_of, nvidia_config
from dual_system.models.groot.pounce import GrootPounce
from dual_system.models.pi05 import weights as pi05_weights
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder, weights_hash
from dual_system.models.pounce.checkpoint import (
    CONFIG_FILE,
    EAGLE_TOKENIZER_FILE,
    TOKENIZER_FILE,
    WEIGHTS_FILE,
    PounceBundle,
    load_bundle,
)
from dual_system.models.public_layout import COGNITION, write_tensors
from dual_system.models.stored_tensors import StoredTensors
from protocol import files
from protocol.command_line import command, parse

PREFIX_FILE = "pounce_prefix.safetensors"
Layout = Literal["openpi", "lerobot"]
_STATE_TOKEN = "state_proj."


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Writes a trained model as a public folder: Qwen3.5's, pi0.5's or GR00T N1.5's."""

    ponder: Path | None = None
    """PONDER's checkpoint. Give either this or --pounce."""
    pounce: Path | None = None
    """POUNCE's checkpoint."""
    out: Path
    """Folder to write; it must not exist yet."""
    layout: Layout = "openpi"
    """Names of pi0.5's tensors: lerobot's have a leading `model.`."""


@command("pp-export hf")
def main(argv: list[str] | None = None, prog: str = "pp-export hf") -> int:
    options = parse(ExportOptions, argv, prog=prog)
    export_folder(options)
    sys.stdout.write(f"{options.out}: read back, equal to the last bit\n")
    return 0


def export_folder(options: ExportOptions) -> None:
    """Writes the folder, and removes it if it cannot be read back.

    Raises:
        ValueError: neither or both models are given, or the model has parts that the layout has no place for.
        FileNotFoundError: the checkpoint does not exist.
        FileExistsError: the output folder exists already.
    """
    if (options.ponder is None) == (options.pounce is None):
        raise ValueError("give one of --ponder and --pounce; each is a folder of its own")
    if options.out.exists():
        raise FileExistsError(f"{options.out} is there already; export to a new folder")
    try:
        with files.writing(options.out):
            if options.ponder is not None:
                _export_ponder(options.ponder, options.out)
            elif options.pounce is not None:
                _export_pounce(load_bundle(options.pounce), options.out, options.layout)
    except BaseException:
        shutil.rmtree(options.out, ignore_errors=True)
        raise


def _export_ponder(folder: Path, out: Path) -> None:
    ponder = load_ponder(folder)
    save_ponder(ponder, out)
    if weights_hash(load_ponder(out)) != weights_hash(ponder):
        raise ValueError(f"{out}: read back, the weights are others than those of {folder}")


def _export_pounce(bundle: PounceBundle, out: Path, layout: Layout) -> None:
    model = bundle.model
    out.mkdir(parents=True)
    path = out / WEIGHTS_FILE
    if isinstance(model, Pounce):
        pi05_weights.save_weights(model, path)
        (out / TOKENIZER_FILE).write_bytes(bundle.tokenizer.model_bytes)
    else:
        groot_weights.save_weights(model, path)
        (out / EAGLE_TOKENIZER_FILE).write_bytes(bundle.tokenizer.model_bytes)
        (out / CONFIG_FILE).write_text(json.dumps(nvidia_config(model.config.groot, model.config.num_steps), indent=1))
    _set_prefix_apart(path, out / PREFIX_FILE, "model." if layout == "lerobot" and isinstance(model, Pounce) else "")
    if isinstance(model, GrootPounce):
        _check_groot(model, out)
    _check_tensors(model, path)


def _set_prefix_apart(path: Path, prefix_path: Path, leading: str) -> None:
    """Moves the cognition prefix from ``path`` to ``prefix_path``; the other names get the prefix ``leading``.

    Raises:
        ValueError: the state enters as a token, which public pi0.5 does not support.
    """
    tensors = dict(StoredTensors.of(path).read())
    ours = {name: tensor for name, tensor in tensors.items() if name.startswith(COGNITION)}
    if any(name.startswith(_STATE_TOKEN) for name in tensors):
        raise ValueError(
            "this checkpoint reads the state as a token (state_input 'token'); public pi0.5 reads it in the prompt and "
            "has no such weights, so it cannot be exported"
        )
    write_tensors({leading + name: tensor for name, tensor in tensors.items() if name not in ours}, path)
    if ours:
        write_tensors(ours, prefix_path)


def _check_groot(model: GrootPounce, out: Path) -> None:
    """Raises ValueError unless the folder determines the network; SigLIP's head count, for one, is not in it."""
    shapes, values = StoredTensors.of(out / WEIGHTS_FILE).shapes, json.loads((out / CONFIG_FILE).read_text())
    found = groot_config_of(shapes, values, str(out))
    if found != (model.config.groot, model.config.num_steps):
        raise ValueError(
            "NVIDIA's folder cannot tell this network: read back it would be another one. Its vision tower must have "
            "as many heads as the published one, and its image token the published place in the vocabulary."
        )


def _check_tensors(model: Pounce | GrootPounce, path: Path) -> None:
    """Raises ValueError unless every public tensor reads back equal to the model's."""
    if isinstance(model, Pounce):
        found, public_name = pi05_weights.read_weights(path), pi05_weights.public_name
    else:
        found, public_name = groot_weights.read_weights(path), groot_weights.public_name
    wanted: dict[str, Tensor] = {public_name(name): tensor for name, tensor in model.state_dict().items()}
    wanted = {name: tensor for name, tensor in wanted.items() if not name.startswith(COGNITION)}
    differing = found.keys() ^ wanted.keys()
    differing |= {name for name in found.keys() & wanted.keys() if not torch.equal(found[name], wanted[name])}
    if differing:
        raise ValueError(f"{path}: read back, {len(differing)} tensors differ, {sorted(differing)[:5]} among them")


if __name__ == "__main__":
    sys.exit(main())
