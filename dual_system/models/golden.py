"""Golden folders: tiny random models of public implementations, with their inputs and outputs.

A folder holds config.json (architecture and shapes), weights.safetensors (public layout), inputs.safetensors and
expected.safetensors. Sizes are read from config.json. Choices that this package builds in only one way (activations,
norms, where time enters) are compared, and a golden that differs in one is refused.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from dual_system.models.groot import weights as groot_weights
from dual_system.models.groot.blocks import BLOCK_NORM_EPS, BlockConfig
from dual_system.models.groot.eagle import EagleConfig
from dual_system.models.groot.network import GrootConfig
from dual_system.models.groot.pounce import GrootPounce, GrootPounceConfig
from dual_system.models.groot.qwen3 import Qwen3Config
from dual_system.models.interface import CognitionConfig
from dual_system.models.pi05 import weights as pi05_weights
from dual_system.models.pi05.gemma import RMS_NORM_EPS, ROPE_BASE, GemmaConfig
from dual_system.models.pi05.network import TIME_MAX_PERIOD, TIME_MIN_PERIOD, Pi05Config
from dual_system.models.pi05.pounce import Pounce, PounceConfig
from dual_system.models.siglip import LAYER_NORM_EPS, VisionConfig
from protocol.files import read_object

NO_COGNITION = CognitionConfig(num_carriers=0)
_VISION_FACTS = {
    "vision.layer_norm_eps": LAYER_NORM_EPS,
    "vision.activation": "gelu_tanh",
    "vision.post_layernorm": True,
}
_GIVEN = {"images", "image_masks", "token_ids", "token_mask", "actions", "noise", "time"}
_GIVEN_TO_GROOT = {"state", "embodiment_id", "action_mask"}
_EXPECTED = {"velocity", "loss_unreduced", "actions"}
"""Tensors that every golden must have."""


class GoldenError(ValueError):
    """A folder is no golden that this package can run; the message names the file or the config entry."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Golden:
    """A golden folder in memory: its model built and loaded by this package with K = 0, its inputs and outputs."""

    name: str
    model: Pounce | GrootPounce
    given: dict[str, Tensor]
    expected: dict[str, Tensor]
    end_to_end_rows: tuple[int, ...]
    """Samples whose features and actions do not depend on how an implementation treats padding."""


class _Sizes:
    """A parsed config.json, indexed by dotted names."""

    def __init__(self, values: dict[str, Any], where: str) -> None:
        self._values = values
        self._where = where

    def find(self, name: str) -> Any:
        """Returns the value, or None if the file has no such entry."""
        value: Any = self._values
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return value

    def __getitem__(self, name: str) -> Any:
        value = self.find(name)
        if value is None:
            raise GoldenError(f"{self._where}: no {name}; see the README of the goldens for the format")
        return value

    def check(self, facts: dict[str, object]) -> None:
        """Raises GoldenError for facts that differ from what the network is built with."""
        wrong = [
            f"{name} is {self.find(name)!r}, built here is {fact!r} only"
            for name, fact in facts.items()
            if self.find(name) not in (None, fact)
        ]
        if wrong:
            raise GoldenError(f"{self._where}: {'; '.join(wrong)}")


def read_golden(folder: Path) -> Golden:
    """Reads a folder and loads its weights through the package's own loader.

    Raises:
        ValueError: a file or a size is missing or broken, or the architecture differs from this package's.
        WeightsError: the weights do not fit the configuration.
    """
    sizes = _Sizes(read_object(folder / "config.json"), str(folder / "config.json"))
    given, expected = (_read_tensors(folder / f"{name}.safetensors") for name in ("inputs", "expected"))
    weights = folder / "weights.safetensors"
    model: Pounce | GrootPounce
    if sizes["family"] == "pi05":
        with torch.device("meta"):
            model = Pounce(pi05_config(sizes))
        pi05_weights.load_weights(model, weights)
    elif sizes["family"] == "groot_n1_5":
        with torch.device("meta"):
            model = GrootPounce(groot_config(sizes))
        groot_weights.load_weights(model, weights)
    else:
        raise GoldenError(f"{folder}: family is {sizes['family']!r}, expected 'pi05' or 'groot_n1_5'")
    _require(given, _GIVEN | (set() if isinstance(model, Pounce) else _GIVEN_TO_GROOT), folder / "inputs.safetensors")
    _require(expected, _EXPECTED, folder / "expected.safetensors")
    rows = sizes.find("end_to_end_rows")
    return Golden(
        name=folder.name,
        model=model.eval().requires_grad_(False),
        given=given,
        expected=expected,
        end_to_end_rows=tuple(range(len(given["actions"]))) if rows is None else tuple(rows),
    )


def pi05_config(sizes: _Sizes) -> PounceConfig:
    streams = {
        f"{stream}.{fact}": value
        for stream in ("llm", "expert")
        for fact, value in (("rope_theta", ROPE_BASE), ("rms_norm_eps", RMS_NORM_EPS), ("activation", "gelu_tanh"))
    }
    time_embedding = {
        "time_embedding.min_period": TIME_MIN_PERIOD,
        "time_embedding.max_period": TIME_MAX_PERIOD,
        "time_embedding.dim": sizes["expert.width"],
    }
    sizes.check(_VISION_FACTS | streams | time_embedding | {"expert.adarms": True, "vision.pooling_head": False})
    return PounceConfig(
        pi05=Pi05Config(
            vision=_vision(sizes),
            language=_gemma(sizes, "llm"),
            expert=_gemma(sizes, "expert"),
            vocab_size=sizes["llm.vocab"],
            action_dim=sizes["action_dim"],
            horizon=sizes["horizon"],
        ),
        cognition=NO_COGNITION,
        robot_action_dim=sizes["real_action_dim"],
        num_cameras=sizes["views"],
        num_steps=sizes["num_steps"],
    )


def groot_config(sizes: _Sizes) -> GrootPounceConfig:
    mixer, dit = _block(sizes, "vl_mixer"), _block(sizes, "dit")
    sizes.check(
        _VISION_FACTS
        | {
            "connector.layers": 1,
            "connector.pixel_shuffle": False,
            "llm.activation": "silu",
            "llm.qk_norm": True,
            "llm.causal": True,
            "llm.final_norm": True,
            "select_layer": sizes["llm.depth"],
            "vl_mixer.width": mixer.width,
            "vl_mixer.vlln": True,
            "vl_mixer.layer_norm_eps": BLOCK_NORM_EPS,
            "vl_mixer.activation": "gelu_tanh",
            "dit.width": dit.width,
            "dit.cross_attention_dim": mixer.width,
            "dit.output_dim": sizes["head.hidden"],
            "dit.interleave_self_attention": True,
            "dit.activation": "gelu_tanh",
            "head.input_embedding_dim": dit.width,
            "head.add_pos_embed": True,
            "head.max_state_dim": sizes["state_dim"],
        }
    )
    return GrootPounceConfig(
        groot=GrootConfig(
            eagle=EagleConfig(
                vision=_vision(sizes),
                language=Qwen3Config(
                    width=sizes["llm.width"],
                    depth=sizes["llm.depth"],
                    mlp_width=sizes["llm.mlp"],
                    num_heads=sizes["llm.heads"],
                    num_kv_heads=sizes["llm.kv_heads"],
                    head_dim=sizes["llm.head_dim"],
                    vocab_size=sizes["llm.vocab"],
                    rope_base=sizes["llm.rope_theta"],
                    norm_eps=sizes["llm.rms_norm_eps"],
                ),
                image_token_id=sizes["image_token_id"],
            ),
            mixer=mixer,
            dit=dit,
            hidden_width=sizes["head.hidden"],
            num_embodiments=sizes["head.max_num_embodiments"],
            num_future_tokens=sizes["head.future_tokens"],
            max_actions=sizes["head.max_seq_len"],
            time_channels=sizes["dit.timestep_channels"],
            num_time_buckets=sizes["head.num_timestep_buckets"],
            state_dim=sizes["state_dim"],
            action_dim=sizes["action_dim"],
            horizon=sizes["horizon"],
        ),
        cognition=NO_COGNITION,
        embodiment=0,
        robot_action_dim=sizes["real_action_dim"],
        robot_state_dim=sizes["real_state_dim"],
        num_cameras=sizes["views"],
        num_steps=sizes["num_steps"],
    )


def _vision(sizes: _Sizes) -> VisionConfig:
    return VisionConfig(
        width=sizes["vision.hidden"],
        depth=sizes["vision.depth"],
        num_heads=sizes["vision.heads"],
        mlp_width=sizes["vision.mlp"],
        image_px=sizes["vision.image_size"],
        patch_px=sizes["vision.patch"],
    )


def _gemma(sizes: _Sizes, stream: str) -> GemmaConfig:
    return GemmaConfig(
        width=sizes[f"{stream}.width"],
        depth=sizes[f"{stream}.depth"],
        mlp_width=sizes[f"{stream}.mlp"],
        num_heads=sizes[f"{stream}.heads"],
        num_kv_heads=sizes[f"{stream}.kv_heads"],
        head_dim=sizes[f"{stream}.head_dim"],
    )


def _block(sizes: _Sizes, stack: str) -> BlockConfig:
    return BlockConfig(
        depth=sizes[f"{stack}.depth"],
        num_heads=sizes[f"{stack}.heads"],
        head_dim=sizes[f"{stack}.head_dim"],
        mlp_width=sizes[f"{stack}.mlp"],
    )


def _require(tensors: dict[str, Tensor], names: set[str], path: Path) -> None:
    if lacking := sorted(names - tensors.keys()):
        raise GoldenError(f"{path}: no {', '.join(lacking)}")


def _read_tensors(path: Path) -> dict[str, Tensor]:
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise GoldenError(f"{path}: {error}") from error
