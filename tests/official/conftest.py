"""An official folder at tiny size: both networks behind any prefixes, bfloat16, the interface under made-up names."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from dual_system.models.normalisation import ROBOMME
from dual_system.models.pi05.pounce import Pounce, PounceConfig
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights
from dual_system.models.pi05.weights import public_name
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce.checkpoint import StoredConfig
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce

HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
STATISTICS = {
    "state": {"q01": [-1.0] * 7 + [0.0], "q99": [1.5] * 7 + [0.04], "mean": [0.0] * 8},
    "action": {"q01": [-0.2] * 7 + [-1.0], "q99": [0.3] * 7 + [1.0]},
    "delta_mask": [True] * 7 + [False],
}


@dataclass
class Release:
    """The folder, what was put into it, and the tokenizers that are elsewhere."""

    folder: Path
    qwen: Path
    paligemma: Path
    pounce_like: Path
    ponder: Ponder
    pounce: Pounce
    tensors: dict[str, Tensor]
    s1: str
    s2: str
    config: dict[str, object] = field(default_factory=lambda: {"s1": {}, "s2": {"max_context_tokens": 16384}})
    statistics: dict[str, object] = field(default_factory=lambda: dict(STATISTICS))

    def write(self) -> Path:
        self.folder.mkdir(exist_ok=True)
        save_file(self.tensors, self.folder / "model.safetensors")
        (self.folder / "config.json").write_text(json.dumps(self.config))
        (self.folder / "norm_stats.json").write_text(json.dumps(self.statistics))
        return self.folder

    def names(self, words: Iterable[str]) -> list[str]:
        return [name for name in self.tensors if all(word in name for word in words)]


MakeRelease = Callable[..., Release]


@pytest.fixture
def make_release(tmp_path: Path) -> MakeRelease:
    def make(
        *,
        s1: str = "zq7.policy.",
        s2: str = "zq7.mllm.kk.",
        num_carriers: int = 1,
        is_tied: bool = False,
        stores: str = "both",
        age_bias: bool = True,
    ) -> Release:
        """``stores``: PaliGemma's embedding as "both" matrices, the "head" alone, or "embed_tokens" alone."""
        ponder, pounce = _networks(num_carriers, is_tied, age_bias)
        tensors = _tensors(ponder, pounce, s1=s1, s2=s2, stores=stores, is_tied=is_tied)
        _save_elsewhere(tmp_path, ponder, pounce.config)
        return Release(
            folder=tmp_path / "official",
            qwen=tmp_path / "qwen",
            paligemma=tmp_path / "tokenizer.model",
            pounce_like=tmp_path / "like",
            ponder=ponder,
            pounce=pounce,
            tensors=tensors,
            s1=s1,
            s2=s2,
        )

    return make


@cache
def _networks(num_carriers: int, is_tied: bool, age_bias: bool) -> tuple[Ponder, Pounce]:
    ponder_config = replace(
        tiny_ponder(),
        num_layers=4,
        vision_depth=1,
        image_px=(64, 64),
        num_carriers=num_carriers,
        tied_embeddings=is_tied,
    )
    ponder = Ponder.random(ponder_config, Vocabulary.tiny(), seed=1)
    config = tiny_pounce(num_carriers=num_carriers, cognition_size=ponder.hidden_size)
    cognition = replace(config.cognition, age_features=32 + 2, age_bias=age_bias)
    pounce = random_pounce(replace(config, cognition=cognition, state_input="token", stateless_prompt="task"), seed=2)
    prefix, generator = pounce.cognition_prefix, torch.Generator().manual_seed(3)
    assert prefix is not None
    with torch.no_grad():  # a random one has zeros here, which would show nothing
        for zeros in (prefix.null_cognition, prefix.projector.bias, prefix.age_projection.bias):
            if zeros is not None:
                zeros.normal_(generator=generator)
    return ponder, pounce


@cache
def _tokenizer() -> bytes:
    return tiny_tokenizer_for_random_weights().model_bytes


def _tensors(ponder: Ponder, pounce: Pounce, *, s1: str, s2: str, stores: str, is_tied: bool) -> dict[str, Tensor]:
    tensors = {s2 + "vlm." + name: each for name, each in ponder.qwen.state_dict().items()}
    if is_tied:
        tensors.pop(s2 + "vlm.lm_head.weight")
    carriers = ponder.format.carrier_ids
    rows = ponder.qwen.model.language_model.embed_tokens.weight[list(carriers)]
    tensors[s2 + "soft_tokens"] = rows
    own = {public_name(name): each for name, each in pounce.state_dict().items()}
    made_up = {
        "pounce_prefix.null_cognition": "nothing_yet",
        "pounce_prefix.projector.weight": "bridge.weight",
        "pounce_prefix.projector.bias": "bridge.bias",
        "pounce_prefix.age_projection.weight": "clock.weight",
        "pounce_prefix.age_projection.bias": "clock.bias",
        "state_proj.weight": "joints.weight",
        "state_proj.bias": "joints.bias",
    }
    tensors |= {s1 + made_up.get(name, "net." + name): each for name, each in own.items()}
    head = tensors[s1 + "net." + HEAD]
    if stores != "head":
        tensors[s1 + "net." + EMBEDDING] = head
    if stores == "embed_tokens":
        tensors.pop(s1 + "net." + HEAD)
    expert = torch.ones(head.shape[0], pounce.config.pi05.expert.width)
    tensors[s1 + "net.paligemma_with_expert.gemma_expert.lm_head.weight"] = expert
    return {name: each.detach().to(torch.bfloat16).clone() for name, each in tensors.items()}


def _save_elsewhere(path: Path, ponder: Ponder, config: PounceConfig) -> None:
    """Tokenizers and configurations as the importer is given them."""
    (path / "qwen").mkdir()
    (path / "like").mkdir()
    ponder.qwen.config.save_pretrained(path / "qwen")
    ponder.format.vocabulary.save(path / "qwen")
    (path / "tokenizer.model").write_bytes(_tokenizer())
    like = StoredConfig(is_random=True, has_fresh_prefix=True, config=config, statistics=ROBOMME)
    (path / "like" / "config.json").write_text(json.dumps(asdict(like)))
