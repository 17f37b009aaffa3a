"""A POUNCE checkpoint folder: config.json, model.safetensors and tokenizer.model, all that acting needs."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import torch

from ponderpounce.models.config_json import from_json
from ponderpounce.models.normalisation import ROBOMME, RobotStatistics
from ponderpounce.models.pi05_weights import load_weights, save_weights
from ponderpounce.models.pounce import Pounce, PounceConfig
from ponderpounce.models.pounce_configs import pi05_base
from ponderpounce.models.pounce_init import initialise_prefix, random_pounce
from ponderpounce.models.prompt import Tokenizer, tiny_tokenizer_for_random_weights

FORMAT: Final = "ponderpounce.pounce/1"
CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
TOKENIZER_FILE = "tokenizer.model"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredConfig:
    """Contents of config.json."""

    format: Literal["ponderpounce.pounce/1"] = FORMAT
    is_random: bool
    has_fresh_prefix: bool
    config: PounceConfig
    statistics: RobotStatistics


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
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

    def stored_config(self) -> StoredConfig:
        return StoredConfig(
            is_random=self.is_random,
            has_fresh_prefix=self.has_fresh_prefix,
            config=self.model.config,
            statistics=self.statistics,
        )

    def digest(self) -> str:
        """Returns 16 hex digits over weights, config, statistics and tokenizer: equal digests act equally."""
        digest = hashlib.blake2b(digest_size=8)
        digest.update(json.dumps(asdict(self.stored_config()), sort_keys=True).encode())
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
    (folder / CONFIG_FILE).write_text(json.dumps(asdict(bundle.stored_config()), indent=1) + "\n")
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
    stored = _read_config(folder / CONFIG_FILE)
    if stored is not None:
        if config is not None:
            raise ValueError(f"checkpoint {folder} has its own {CONFIG_FILE}; leave the config argument out")
        config = stored.config
    with torch.device("meta"):
        model = Pounce(config or pi05_base())
    has_prefix = load_weights(model, weights_path)
    if not has_prefix:
        initialise_prefix(model, torch.Generator().manual_seed(prefix_seed))
    is_prefix_trained = has_prefix and not (stored is not None and stored.has_fresh_prefix)
    return PounceBundle(
        model=model,
        tokenizer=Tokenizer.from_file(tokenizer or folder / TOKENIZER_FILE),
        statistics=ROBOMME if stored is None else stored.statistics,
        is_random=stored is not None and stored.is_random,
        has_fresh_prefix=model.cognition_prefix is not None and not is_prefix_trained,
    )


def _read_config(path: Path) -> StoredConfig | None:
    """Returns None for a public folder: no config.json, or one that is not in our format."""
    if not path.is_file():
        return None
    values = json.loads(path.read_text())
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        return None
    return from_json(StoredConfig, values, path.name)
