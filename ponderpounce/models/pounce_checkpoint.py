"""A POUNCE checkpoint folder: config.json, model.safetensors and tokenizer.model, all that acting needs."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ponderpounce.models.config_json import from_json
from ponderpounce.models.normalisation import ROBOMME, RobotStatistics
from ponderpounce.models.pi05_weights import load_weights, save_weights
from ponderpounce.models.pounce import Pounce, PounceConfig
from ponderpounce.models.pounce_configs import pi05_base
from ponderpounce.models.pounce_init import initialise_prefix, random_pounce
from ponderpounce.models.prompt import Tokenizer, tiny_tokenizer_for_random_weights

FORMAT = "ponderpounce.pounce/1"
CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
TOKENIZER_FILE = "tokenizer.model"


@dataclass(frozen=True, slots=True, kw_only=True)
class PounceBundle:
    """A model with what surrounds it: how to read text, and what its numbers mean on the robot."""

    model: Pounce
    tokenizer: Tokenizer
    statistics: RobotStatistics = ROBOMME
    is_random: bool
    """True where the weights were drawn, not trained: nothing it does is skill."""
    has_fresh_prefix: bool
    """True where the cognition prefix is untrained, though pi0.5 itself may be."""

    def __post_init__(self) -> None:
        config = self.model.config
        if self.tokenizer.vocab_size > config.pi05.vocab_size:
            raise ValueError(
                f"tokenizer has {self.tokenizer.vocab_size} ids, the model embeds {config.pi05.vocab_size}"
            )
        if self.statistics.action.num_dims != config.robot_action_dim:
            raise ValueError(
                f"statistics describe {self.statistics.action.num_dims} action dims, "
                f"the config {config.robot_action_dim}"
            )

    def digest(self) -> str:
        """Returns 16 hex digits over weights, config, statistics and tokenizer: equal digests act equally."""
        digest = hashlib.blake2b(digest_size=8)
        digest.update(json.dumps(_to_json(self), sort_keys=True).encode())
        digest.update(self.tokenizer.model_bytes)
        for name, tensor in sorted(self.model.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.contiguous().cpu().view(torch.uint8).numpy())
        return digest.hexdigest()


def random_bundle(config: PounceConfig, seed: int) -> PounceBundle:
    """A bundle that needs no file: seeded random weights and the tiny tokenizer."""
    return PounceBundle(
        model=random_pounce(config, seed),
        tokenizer=tiny_tokenizer_for_random_weights(),
        is_random=True,
        has_fresh_prefix=config.cognition.num_carriers > 0,
    )


def save_bundle(bundle: PounceBundle, folder: Path) -> None:
    """Writes the folder that `load_bundle` reads; its weights are in the public layout (`pi05_weights`)."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG_FILE).write_text(json.dumps(_to_json(bundle), indent=1) + "\n")
    (folder / TOKENIZER_FILE).write_bytes(bundle.tokenizer.model_bytes)
    save_weights(bundle.model, folder / WEIGHTS_FILE)


def load_bundle(
    folder: Path, *, config: PounceConfig | None = None, tokenizer: Path | None = None, prefix_seed: int = 0
) -> PounceBundle:
    """Reads our own folder, or a public pi0.5 one, which acts with RoboMME's statistics.

    Args:
        config: for a public folder, whose config.json is another dialect; default `pi05_base()`.
        tokenizer: SentencePiece file; default the folder's tokenizer.model.
        prefix_seed: draws the cognition prefix where the folder has none.

    Raises:
        FileNotFoundError: no weights, or no tokenizer anywhere.
        WeightsError: the tensors do not fit the configuration.
        ValueError: our config.json does not parse, or ``config`` is given although the folder has its own.
    """
    weights_path = folder / WEIGHTS_FILE
    if not weights_path.is_file():
        raise FileNotFoundError(f"checkpoint {folder} has no {WEIGHTS_FILE}")
    config_path = folder / CONFIG_FILE
    stored = json.loads(config_path.read_text()) if config_path.is_file() else {}
    is_random, statistics = False, ROBOMME
    if stored.get("format") == FORMAT:
        if config is not None:
            raise ValueError(f"checkpoint {folder} has its own {CONFIG_FILE}; leave the config argument out")
        config = from_json(PounceConfig, stored["config"], CONFIG_FILE)
        statistics = from_json(RobotStatistics, stored["statistics"], CONFIG_FILE)
        is_random = bool(stored["is_random"])
    with torch.device("meta"):
        model = Pounce(config or pi05_base())
    has_prefix = load_weights(model, weights_path)
    if not has_prefix:
        initialise_prefix(model, torch.Generator().manual_seed(prefix_seed))
    return PounceBundle(
        model=model,
        tokenizer=Tokenizer.from_file(tokenizer or folder / TOKENIZER_FILE),
        statistics=statistics,
        is_random=is_random,
        has_fresh_prefix=stored.get("has_fresh_prefix", False) if has_prefix else model.cognition_prefix is not None,
    )


def _to_json(bundle: PounceBundle) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "is_random": bundle.is_random,
        "has_fresh_prefix": bundle.has_fresh_prefix,
        "config": dataclasses.asdict(bundle.model.config),
        "statistics": dataclasses.asdict(bundle.statistics),
    }
