"""A POUNCE checkpoint folder: config.json, model.safetensors and a tokenizer, all that acting needs.

The format in config.json names the family; a public folder's family is recognised by its tensor names.
"""

import hashlib
import json
import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import torch

from dual_system.hub import local_folder
from dual_system.models.config_json import deviations, from_json
from dual_system.models.groot.folder import groot_config_of
from dual_system.models.groot.pounce import GrootPounceConfig
from dual_system.models.groot.prompt import EagleTokenizer, tiny_eagle_tokenizer_for_random_weights
from dual_system.models.normalisation import ROBOMME, Quantiles, RobotStatistics
from dual_system.models.pi05.folder import with_sizes_of
from dual_system.models.pi05.openpi_jax import METADATA_FILE, load_jax_weights
from dual_system.models.pi05.pounce import Pounce, PounceConfig
from dual_system.models.pi05.prompt import Tokenizer, tiny_tokenizer_for_random_weights
from dual_system.models.pounce.configs import groot_n1_5, pi05_base
from dual_system.models.pounce.family import (
    AnyPounce,
    AnyPounceConfig,
    blank_model,
    family_of,
    load_weights,
    random_model,
    save_weights,
)
from dual_system.models.pounce.initialise import initialise_missing, initialise_prefix
from dual_system.models.public_statistics import read_statistics, statistics_files
from dual_system.models.stored_tensors import CheckpointError, StoredTensors, refuse_quantised, require_layers
from protocol.files import read_object

log = logging.getLogger(__name__)

AnyTokenizer: TypeAlias = Tokenizer | EagleTokenizer

FORMAT: Final = "ponderpounce.pounce/1"
GROOT_FORMAT: Final = "ponderpounce.pounce-groot/1"
CONFIG_FILE = "config.json"
JAX_FOLDER = "params"
WEIGHTS_FILE = "model.safetensors"
TOKENIZER_FILE = "tokenizer.model"
EAGLE_TOKENIZER_FILE = "tokenizer.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredConfig:
    """Contents of config.json with pi0.5 inside."""

    format: Literal["ponderpounce.pounce/1"] = FORMAT
    is_random: bool
    has_fresh_prefix: bool
    config: PounceConfig
    statistics: RobotStatistics


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredGrootConfig:
    """Contents of config.json with GR00T inside."""

    format: Literal["ponderpounce.pounce-groot/1"] = GROOT_FORMAT
    is_random: bool
    has_fresh_prefix: bool
    config: GrootPounceConfig
    statistics: RobotStatistics


AnyStoredConfig: TypeAlias = StoredConfig | StoredGrootConfig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PounceBundle:
    """A model with its tokenizer and the statistics that map its numbers to the robot."""

    model: AnyPounce
    tokenizer: AnyTokenizer
    statistics: RobotStatistics = ROBOMME
    is_random: bool
    """True if the weights are random, not trained."""
    has_fresh_prefix: bool
    """True if the cognition prefix is untrained, even if the rest is trained."""

    def __post_init__(self) -> None:
        config = self.model.config
        expected = Tokenizer if isinstance(config, PounceConfig) else EagleTokenizer
        if not isinstance(self.tokenizer, expected):
            raise ValueError(f"the model reads with {expected.__name__}, came {type(self.tokenizer).__name__}")
        if self.tokenizer.vocab_size > config.vocab_size:
            raise ValueError(f"tokenizer has {self.tokenizer.vocab_size} ids, the model embeds {config.vocab_size}")
        if isinstance(config, GrootPounceConfig) and isinstance(self.tokenizer, EagleTokenizer):
            image_token_id = config.groot.eagle.image_token_id
            if self.tokenizer.image_token_id != image_token_id:
                raise ValueError(
                    f"the tokenizer's image token is {self.tokenizer.image_token_id}, the model's {image_token_id}"
                )
        if not isinstance(config, PounceConfig) or config.state_input == "token":
            self._check_dims("state", self.statistics.state, config.robot_state_dim)
        self._check_dims("action", self.statistics.action, config.robot_action_dim)

    def _check_dims(self, what: str, table: Quantiles, expected: int) -> None:
        if table.num_dims != expected:
            raise ValueError(
                f"statistics describe {table.num_dims} {what} dims, the config {expected}; with their action space "
                f"{self.statistics.space!r} its robot_{what}_dim must be {table.num_dims} (`pounce.configs.in_space`)"
            )

    def stored_config(self) -> AnyStoredConfig:
        config = self.model.config
        facts: dict[str, Any] = {
            "is_random": self.is_random,
            "has_fresh_prefix": self.has_fresh_prefix,
            "statistics": self.statistics,
        }
        if isinstance(config, PounceConfig):
            return StoredConfig(config=config, **facts)
        return StoredGrootConfig(config=config, **facts)

    def digest(self) -> str:
        """Returns 16 hex digits over weights, config, statistics and tokenizer: equal digests act equally."""
        digest = hashlib.blake2b(digest_size=8)
        digest.update(json.dumps(deviations(self.stored_config()), sort_keys=True).encode())
        digest.update(self.tokenizer.model_bytes)
        for name, tensor in sorted(self.model.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.contiguous().cpu().view(torch.uint8).numpy())
        return digest.hexdigest()


def random_bundle(
    config: AnyPounceConfig,
    seed: int,
    *,
    statistics: RobotStatistics = ROBOMME,
    tokenizer: AnyTokenizer | None = None,
    device: torch.device | str = "cpu",
) -> PounceBundle:
    """A bundle without files: seeded random weights on ``device``, and a tiny tokenizer unless another is given."""
    if tokenizer is None:
        is_pi05 = isinstance(config, PounceConfig)
        tokenizer = tiny_tokenizer_for_random_weights() if is_pi05 else tiny_eagle_tokenizer_for_random_weights()
    return PounceBundle(
        model=random_model(config, seed, device),
        tokenizer=tokenizer,
        statistics=statistics,
        is_random=True,
        has_fresh_prefix=config.cognition.num_carriers > 0,
    )


def save_bundle(bundle: PounceBundle, folder: Path) -> None:
    """Writes the folder that `load_bundle` reads; its weights are in the family's public layout."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG_FILE).write_text(json.dumps(asdict(bundle.stored_config()), indent=1) + "\n")
    (folder / _tokenizer_file(bundle.model.config)).write_bytes(bundle.tokenizer.model_bytes)
    save_weights(bundle.model, folder / WEIGHTS_FILE)


def declares_config(folder: Path) -> bool:
    """Whether a folder's config.json is in our format; a public folder's is not."""
    return _read_config(local_folder(folder) / CONFIG_FILE)[1] is not None


def load_bundle(
    folder: Path,
    *,
    config: AnyPounceConfig | None = None,
    statistics: RobotStatistics | None = None,
    tokenizer: Path | None = None,
    prefix_seed: int = 0,
) -> PounceBundle:
    """Reads our own folder, or a public one; the latter's statistics are its own, or else RoboMME's, and are logged.

    Either may be on the hub (`local_folder`). Public folders: openpi's pi0.5 (PyTorch, or JAX in ``params/``) and
    lerobot's; NVIDIA's GR00T N1.5, in shards or not, and lerobot's ``groot``.

    Args:
        config: for a public folder; default that of `public_config`.
        statistics: for a public folder, in place of its own; ``config`` must be in their action space.
        tokenizer: tokenizer file; default the folder's tokenizer.model (pi0.5) or tokenizer.json (GR00T).
        prefix_seed: seed of the cognition prefix if the folder has none.

    Raises:
        OSError: no weights, no tokenizer anywhere, or a file that may not be read.
        CheckpointError: the tensors do not fit the configuration, are quantised, or not finite.
        ValueError: a file is broken or a Git LFS pointer, a public folder's statistics are not of this robot, or
            ``config`` or ``statistics`` is given although the folder has its own.
    """
    folder = local_folder(folder)
    is_jax = (folder / JAX_FOLDER / METADATA_FILE).is_file()
    tensors = None if is_jax else StoredTensors.of(folder / WEIGHTS_FILE)
    values, stored = _read_config(folder / CONFIG_FILE)
    if tensors is not None:
        require_layers(values, tensors, folder / CONFIG_FILE)
    if stored is not None:
        for name, given in (("config", config), ("statistics", statistics)):
            if given is not None:
                raise ValueError(f"checkpoint {folder} has its own {CONFIG_FILE}; leave the {name} argument out")
        config, statistics = stored.config, stored.statistics
    else:
        statistics = _public_statistics(folder, statistics)
    if config is None:
        config = _public_config(tensors, values, folder)
    try:
        model = blank_model(config)
    except (ArithmeticError, RuntimeError) as error:
        raise CheckpointError(f"{folder / CONFIG_FILE} describes no network: {error}") from error
    has_prefix = _load_jax(model, folder) if is_jax else load_weights(model, folder / WEIGHTS_FILE)
    if not has_prefix:
        initialise_prefix(model, torch.Generator().manual_seed(prefix_seed))
    if isinstance(model, Pounce):
        initialise_missing(model, torch.Generator().manual_seed(prefix_seed))
    is_prefix_trained = has_prefix and not (stored is not None and stored.has_fresh_prefix)
    return PounceBundle(
        model=model,
        tokenizer=_read_tokenizer(model.config, tokenizer or folder / _tokenizer_file(model.config)),
        statistics=statistics,
        is_random=stored is not None and stored.is_random,
        has_fresh_prefix=model.cognition_prefix is not None and not is_prefix_trained,
    )


def _load_jax(model: AnyPounce, folder: Path) -> bool:
    """Returns False: openpi has no cognition prefix."""
    if not isinstance(model, Pounce):
        raise ValueError(f"checkpoint {folder} is openpi's JAX pi0.5, its config is GR00T's")
    load_jax_weights(model, folder / JAX_FOLDER)
    return False


def public_config(folder: Path) -> AnyPounceConfig:
    """The published configuration of a public folder's family, with the sizes of the folder's own network.

    Raises: as `load_bundle`.
    """
    folder = local_folder(folder)
    is_jax = (folder / JAX_FOLDER / METADATA_FILE).is_file()
    values, _ = _read_config(folder / CONFIG_FILE)
    return _public_config(None if is_jax else StoredTensors.of(folder / WEIGHTS_FILE), values, folder)


def _public_config(tensors: StoredTensors | None, values: dict[str, Any] | None, folder: Path) -> AnyPounceConfig:
    if tensors is None:  # openpi's JAX folder
        return replace(pi05_base(), control_hz=0)
    if family_of(tensors.shapes, str(folder / WEIGHTS_FILE)) == "pi05":
        return with_sizes_of(tensors.shapes, replace(pi05_base(), control_hz=0), str(folder))
    groot, num_steps = groot_config_of(tensors.shapes, values, str(folder))
    return replace(groot_n1_5(), groot=groot, num_steps=num_steps, control_hz=0)


def _public_statistics(folder: Path, given: RobotStatistics | None) -> RobotStatistics:
    """Those given, else the folder's own, else RoboMME's; the log says which, since the policy depends on them."""
    if given is not None:
        if brought := statistics_files(folder):
            log.warning("statistics: given ones in place of %s", ", ".join(map(str, brought)))
        return given
    if (found := read_statistics(folder)) is not None:
        log.warning("statistics: from %s, taken as those of joint deltas and a gripper", statistics_files(folder)[0])
        return found
    log.warning("statistics: %s brings none; RoboMME's published table is used", folder)
    return ROBOMME


def _tokenizer_file(config: AnyPounceConfig) -> str:
    return TOKENIZER_FILE if isinstance(config, PounceConfig) else EAGLE_TOKENIZER_FILE


def _read_tokenizer(config: AnyPounceConfig, path: Path) -> AnyTokenizer:
    return Tokenizer.from_file(path) if isinstance(config, PounceConfig) else EagleTokenizer.from_file(path)


def _read_config(path: Path) -> tuple[dict[str, Any] | None, AnyStoredConfig | None]:
    """Returns the parsed config.json, None without one, and the config in it, None if it is not in our format."""
    if not path.exists() and not path.is_symlink():
        return None, None
    values = read_object(path)
    refuse_quantised(values, path)
    if values.get("format") == FORMAT:
        return values, from_json(StoredConfig, values, str(path))
    if values.get("format") == GROOT_FORMAT:
        return values, from_json(StoredGrootConfig, values, str(path))
    return values, None
