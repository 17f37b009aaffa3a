"""Stage A1: the vision towers of both systems learn to locate things, on pictures that are of no task.

    python -m dual_system.policy.towers --out FOLDER --data SETS

It leaves ``ponder`` and ``pounce``, folders with trained towers and otherwise random weights, from which the next
stages start: what stands in for pretrained models. Tokenizers and statistics are of the data. A tower reads both
cameras; what it predicts for the wrist camera is in the tool's frame.
"""

# B pictures, P their side in px, S tokens

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.family import random_model
from dual_system.models.siglip import VisionTower
from dual_system.policy.album import IMAGE_PX, Album, albums
from dual_system.policy.locating import Located, LocatingHead, located, locating_loss
from dual_system.policy.studio import WINDOWS
from dual_system.training.build import Start, build, export
from dual_system.training.data import TrainingSet
from dual_system.training.joint import JointModel
from dual_system.training.laptop_recipes import laptop_hand
from protocol.command_line import command, parse

_BATCH, _HELD_OUT = 32, 400
_RATE, _WARMUP_STEPS, _DECAYS_FROM = 1e-3, 200, 0.5
_SAVE_EVERY_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TowersOptions:
    """Trains both towers to locate things; the same command goes on after a kill."""

    out: Path
    """Folder of the result, and of the state in between."""
    data: tuple[Path, ...] = ()
    """Datasets whose texts give the tokenizers and whose actions the statistics; none: train, and write no folders."""
    trains: Literal["both", "ponder", "pounce"] = "both"
    """The towers to train here."""
    stills: int = 12_000
    """Scenes to photograph."""
    minutes: float = 60.0
    """Processor time of each tower's training."""
    workers: int = 2
    """Processes that photograph."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tower:
    """A vision tower, and how it reads pictures (B, P, P, 3) uint8 to tokens (B, S, ``width``)."""

    name: str
    module: nn.Module
    read: Callable[[Tensor], Tensor]
    width: int
    token_px: int


@command("towers")
def main(argv: list[str] | None = None) -> int:
    options = parse(TowersOptions, argv, prog="python -m dual_system.policy.towers")
    torch.set_num_threads(1)
    pictures = albums(options.out / "album.npz", options.stills, options.workers)
    run = replace(laptop_hand(), from_scratch=True)
    blank = JointModel(Ponder.random(run.ponder, seed=0), random_model(run.pounce, 0))
    for tower in _towers(blank):
        if options.trains in ("both", tower.name):
            for line in _trained(tower, pictures, options):
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
    if options.data:
        model, bundle = build(run, TrainingSet(*options.data, demo_hz=run.demo_hz), Start())
        for tower in _towers(model):
            _restore(tower, options.out)
        export(model, bundle, options.out, trained="both")
    return 0


def _towers(model: JointModel) -> tuple[_Tower, _Tower]:
    return _pounce_s(model), _ponder_s(model)


def _pounce_s(model: JointModel) -> _Tower:
    if not isinstance(model.pounce, Pounce):
        raise TypeError("the laptop pair's POUNCE is a pi0.5")
    vision = model.pounce.pi05.vision
    return _Tower(
        name="pounce",
        module=vision,
        read=partial(_seen_by_pounce, vision),
        width=vision.config.width,
        token_px=vision.config.patch_px,
    )


def _ponder_s(model: JointModel) -> _Tower:
    ponder = model.ponder
    return _Tower(
        name="ponder",
        module=ponder.qwen.model.visual,
        read=partial(_seen_by_ponder, ponder),
        width=ponder.hidden_size,
        token_px=ponder.format.token_px,
    )


def _seen_by_pounce(tower: VisionTower, pictures_BPP3: Tensor) -> Tensor:
    tokens: Tensor = tower(pictures_BPP3.permute(0, 3, 1, 2).float() / 127.5 - 1, torch.float32)
    return tokens


def _seen_by_ponder(ponder: Ponder, pictures_BPP3: Tensor) -> Tensor:
    return ponder.image_features(pictures_BPP3).unflatten(0, (len(pictures_BPP3), -1))


class _Run:
    """A tower with its heads and optimiser, and the processor time that they have had."""

    def __init__(self, tower: _Tower, out: Path) -> None:
        torch.manual_seed(0)
        self.heads = nn.ModuleDict({camera: LocatingHead(tower.width, tower.token_px) for camera in WINDOWS})
        tower.module.requires_grad_(True)
        self.both = nn.ModuleDict({"tower": tower.module, "heads": self.heads})
        self.optimiser = torch.optim.AdamW(self.both.parameters(), _RATE, weight_decay=0.01)
        self.file = _state_file(tower, out)
        self.spent_s, self.step = 0.0, 0
        if self.file.is_file():
            state: dict[str, Any] = torch.load(self.file, weights_only=True)
            self.both.load_state_dict(state["weights"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.spent_s, self.step = state["spent_s"], state["step"]

    def save(self) -> None:
        state: dict[str, Any] = {
            "weights": self.both.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "spent_s": self.spent_s,
            "step": self.step,
        }
        fresh = self.file.with_suffix(".tmp")
        torch.save(state, fresh)
        fresh.rename(self.file)


def _state_file(tower: _Tower, out: Path) -> Path:
    return out / f"{tower.name}.pt"


def _restore(tower: _Tower, out: Path) -> None:
    """Gives a tower its trained weights. Raises FileNotFoundError if it was not trained."""
    stored: dict[str, Tensor] = torch.load(_state_file(tower, out), weights_only=True)["weights"]
    begin = "tower."
    weights = {name.removeprefix(begin): each for name, each in stored.items() if name.startswith(begin)}
    tower.module.load_state_dict(weights)


def _trained(tower: _Tower, pictures: dict[str, Album], options: TowersOptions) -> Iterator[str]:
    """Trains a tower in place, from its saved state on; yields a line at every save."""
    run, whole_s = _Run(tower, options.out), 60 * options.minutes
    split = {camera: album.split(_HELD_OUT) for camera, album in pictures.items()}
    since_s, saved_s = time.process_time(), run.spent_s
    while run.spent_s < whole_s:
        rest = 1 - run.spent_s / whole_s
        rate = _RATE * min(1.0, (run.step + 1) / _WARMUP_STEPS, max(0.01, rest / (1 - _DECAYS_FROM)))
        for group in run.optimiser.param_groups:
            group["lr"] = rate
        generator = torch.Generator().manual_seed(run.step)
        loss = torch.zeros(())
        for camera, (album, _) in split.items():
            index = torch.randint(len(album.pictures), (_BATCH,), generator=generator)
            loss = loss + locating_loss(run.heads[camera](tower.read(album.pictures[index])), album.labels[index])
        run.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(run.both.parameters(), 1.0)
        run.optimiser.step()
        now_s = time.process_time()
        run.step, run.spent_s, since_s = run.step + 1, run.spent_s + now_s - since_s, now_s
        if run.spent_s - saved_s > _SAVE_EVERY_S or run.spent_s >= whole_s:
            saved_s = run.spent_s
            run.save()
            found = {camera: _found(tower, run.heads[camera], held_out) for camera, (_, held_out) in split.items()}
            told = "; ".join(f"{camera}: {each}" for camera, each in found.items())
            yield f"{tower.name} {run.spent_s / 60:.1f} min, step {run.step}, loss {loss.item():.3f}; {told}"
            since_s = time.process_time()


def _found(tower: _Tower, head: nn.Module, album: Album) -> Located:
    with torch.no_grad():
        outs = [head(tower.read(part)) for part in album.pictures.split(100)]
    return located(torch.cat(outs), album.labels, IMAGE_PX)


if __name__ == "__main__":
    sys.exit(main())
