"""Frozen vision towers of a run: what they make of a picture never changes, so it is computed once and stored.

The paper freezes its backbones; so do recipes with ``freeze`` and ``freezes_ponder_vision``. Half precision moves a
loss by less than two parts in a thousand. It pays where towers are small: a laptop's 64 tokens of 128 numbers are 16 kB
beside a picture's 12, those of pi0.5's SigLIP a megabyte beside 150 kB.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor, nn

from dual_system.models.pi05.pounce import Pounce
from dual_system.training.episode import Frame
from dual_system.training.joint import JointModel
from dual_system.training.picture_store import Views

_PICTURES_AT_ONCE = 128


class FrozenTowers:
    """The vision towers that a run uses and does not train."""

    def __init__(self, model: JointModel) -> None:
        """Raises ValueError unless every system that the run trains with has a frozen one; POUNCE's must be pi0.5."""
        self._ponder, self._pounce = model.ponder, model.pounce
        used: dict[str, tuple[nn.Module, ...]] = {}
        if model.runs_ponder:
            used["ponder"] = (model.ponder.qwen.model.visual,)
        if model.trains != "ponder":
            if not isinstance(model.pounce, Pounce):
                raise ValueError("features of frozen towers are stored for pi0.5, and this POUNCE is a GR00T")
            used["pounce"] = model.pounce.backbone.vision
        towers = [tower for each in used.values() for tower in each]
        if any(parameter.requires_grad for tower in towers for parameter in tower.parameters()):
            raise ValueError(
                "the recipe trains a vision tower: its features change with every step. Take a recipe whose towers are "
                "frozen, or leave --frozen-features out"
            )
        self.keys = {system: _hash(each) for system, each in used.items()}
        """Identifies the towers of each system that the run uses."""

    def features(self, system: str, views: Views) -> Views:
        """A system's pictures as (S, W) float16 tokens each; an instant without any stays so."""
        return _each(views, self._of_ponder if system == "ponder" else self._of_pounce)

    def _of_pounce(self, pictures_MPP3: Tensor) -> Tensor:
        pixels = pictures_MPP3.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        assert isinstance(self._pounce, Pounce)
        device = next(self._pounce.parameters()).device
        return self._pounce.pi05.embed_images(pixels[:, None].to(device))

    def _of_ponder(self, pictures_MHW3: Tensor) -> Tensor:
        features = self._ponder.image_features(pictures_MHW3.to(self._ponder.device))
        return features.unflatten(0, (len(pictures_MHW3), -1))


def _each(instants: Views, tower: Callable[[Tensor], Tensor]) -> Views:
    pictures = [picture for instant in instants for picture in instant]
    found: list[Frame] = []
    with torch.no_grad():
        for begin in range(0, len(pictures), _PICTURES_AT_ONCE):
            some = torch.from_numpy(np.stack(pictures[begin : begin + _PICTURES_AT_ONCE]))
            found += [*tower(some).half().cpu().numpy()]
    features = iter(found)
    return [tuple(next(features) for _ in instant) for instant in instants]


def _hash(towers: Iterable[nn.Module]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for tower in towers:
        for name, tensor in tower.state_dict().items():
            digest.update(name.encode() + tensor.detach().float().cpu().numpy().tobytes())
    return digest.hexdigest()
