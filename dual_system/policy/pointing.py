"""Stage A1, its second part: POUNCE's prefix learns to point at what a text names, on stills that are of no task.

    python -m dual_system.policy.pointing --towers FOLDER --out FOLDER

PaliGemma comes with location tokens that it has learned from pictures of everything. Here a text names one thing in a
still, or two: by its place, a little off, or by its kind where there is one of that kind. The pointer has to choose the
patch that holds it, and the language model learns on the way which token stands for which place. The texts are no
subgoal of any task, the state is always the mean, and the action expert is not trained.
"""

# B stills, V cameras, S patches of a picture, K things (padded), Q places of the pointer

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.pi05.pounce import Pounce, PounceInputs, freeze
from dual_system.models.pi05.prompt import stateless_prompt_text, with_subgoal
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import xy_1000_from_yx_px
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, save_bundle
from dual_system.policy.album import Album, albums
from dual_system.policy.studio import NAMES, WINDOWS
from protocol import files
from protocol.command_line import command, parse

_BATCH, _HELD_OUT, _SEED = 64, 400, 0
_RATE, _WARMUP_STEPS, _DECAYS_FROM = 1e-3, 200, 0.5
_INSTRUCTION = "point"
_PLACED_SHARE, _PAIR_SHARE = 2 / 3, 1 / 3
_JITTER_PX, _CAMERA_PX = 3.2, 256  # as a hand is told places (`laptop_hand`)
_REPORT_EVERY_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PointingOptions:
    """Teaches POUNCE's prefix to point at what a text names."""

    towers: Path
    """Folder of `policy.towers`: its stills, and the pounce to begin with."""
    out: Path
    """Folder for the pounce that points."""
    stills: int = 12_000
    """Number of its stills, if they have to be photographed."""
    minutes: float = 8.0
    """Processor time of the training."""
    workers: int = 2
    """Processes that photograph."""


@command("pointing")
def main(argv: list[str] | None = None) -> int:
    options = parse(PointingOptions, argv, prog="python -m dual_system.policy.pointing")
    torch.set_num_threads(1)
    bundle = load_bundle(options.towers / "pounce")
    if not isinstance(bundle.model, Pounce) or bundle.model.pointer is None:
        raise ValueError(f"{options.towers / 'pounce'} has no pointer: expected a pi0.5 with num_pointed of 1 or more")
    pictures = albums(options.towers / "album.npz", options.stills, options.workers)
    for line in trained(bundle, bundle.model, pictures, options.minutes):
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
    with files.writing(options.out):
        save_bundle(replace(bundle, is_random=False), files.folder(options.out) / "pounce")
    return 0


class Lessons:
    """Texts about things in stills, and the patches that they mean."""

    def __init__(self, bundle: PounceBundle, model: Pounce, pictures: dict[str, Album]) -> None:
        self._bundle, self._model = bundle, model
        self._labels = pictures[next(iter(WINDOWS))].labels
        with torch.no_grad():
            parts = zip(*(album.pictures.split(100) for album in pictures.values()), strict=True)
            self._seen_NSW = torch.cat([self._looked_at(views) for views in parts])

    def _looked_at(self, views: tuple[Tensor, ...]) -> Tensor:
        images_BVPP3 = torch.stack(views, dim=1)
        return self._model.pi05.embed_images(images_BVPP3.permute(0, 1, 4, 2, 3).float() / 127.5 - 1)

    def batch(self, rng: np.random.Generator, *, placed_share: float = _PLACED_SHARE) -> tuple[PounceInputs, Tensor]:
        """The inputs of B stills, and the patches (B, Q) int64 that their texts mean, or `IGNORE`."""
        config, encode = self._model.config, self._bundle.tokenizer.encode
        has_things = torch.nonzero(self._labels.is_real_BK.any(dim=1))[:, 0].numpy()
        stills = rng.choice(has_things, _BATCH)
        lessons = [self.lesson(int(still), rng, placed_share) for still in stills]
        ids = [encode(stateless_prompt_text(with_subgoal(_INSTRUCTION, text))) for text, _ in lessons]
        longest = max(map(len, ids))
        seen_BSW = self._seen_NSW[torch.from_numpy(stills)]
        inputs = PounceInputs(
            images=torch.zeros(_BATCH, config.num_cameras, 3, 1, 1),
            has_view=torch.ones(_BATCH, config.num_cameras, dtype=torch.bool),
            token_ids=torch.tensor([each + [0] * (longest - len(each)) for each in ids]),
            is_token=torch.tensor([[place < len(each) for place in range(longest)] for each in ids]),
            age_ns=torch.zeros(_BATCH, dtype=torch.int64),
            state=torch.zeros(_BATCH, config.robot_state_dim),
            seen=seen_BSW,
        )
        places = [(patches + [IGNORE] * config.num_pointed)[: config.num_pointed] for _, patches in lessons]
        return inputs, torch.tensor(places)

    def lesson(self, still: int, rng: np.random.Generator, placed_share: float) -> tuple[str, list[int]]:
        """A text about one thing of a still, or two, and the patch of each."""
        things = np.flatnonzero(self._labels.is_real_BK[still].numpy())
        count = 2 if len(things) > 1 and rng.random() < _PAIR_SHARE else 1
        chosen = rng.choice(things, count, replace=False)
        names = [self._named(still, int(thing), rng, placed_share) for thing in chosen]
        return " to ".join(names), [self._patch(still, int(thing)) for thing in chosen]

    def _named(self, still: int, thing: int, rng: np.random.Generator, placed_share: float) -> str:
        kinds = self._labels.kind_BK[still][self._labels.is_real_BK[still]]
        kind = int(self._labels.kind_BK[still, thing])
        name = f"the {NAMES[kind]}"
        if int((kinds == kind).sum()) == 1 and rng.random() >= placed_share:
            return name
        top, left, bottom, right = WINDOWS[next(iter(WINDOWS))]
        row, column = self._labels.place_BK2[still, thing].tolist()
        yx = np.array([top + row * (bottom - top), left + column * (right - left)]) * _CAMERA_PX
        y_px, x_px = np.rint(yx + rng.normal(0, _JITTER_PX, 2)).astype(int).clip(0, _CAMERA_PX).tolist()
        return "{} at [{}, {}]".format(name, *xy_1000_from_yx_px((y_px, x_px)))

    def _patch(self, still: int, thing: int) -> int:
        side = round(self._model.config.pi05.vision.num_patches**0.5)
        row, column = (self._labels.place_BK2[still, thing] * side).long().clamp(0, side - 1).tolist()
        return row * side + column


def trained(bundle: PounceBundle, model: Pounce, pictures: dict[str, Album], minutes: float) -> Iterator[str]:
    """Trains the prefix and the pointer's scores in place; yields a line a minute, with hits in held-out stills."""
    halves = {camera: album.split(_HELD_OUT) for camera, album in pictures.items()}
    lessons, held_out = (
        Lessons(bundle, model, {camera: halves[camera][half] for camera in halves}) for half in range(2)
    )
    freeze(model, "vision")
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimiser = torch.optim.AdamW(learning, _RATE, weight_decay=0.01)
    step, spent_s, reported_s, whole_s = 0, 0.0, 0.0, 60 * minutes
    since_s = time.process_time()
    while spent_s < whole_s:
        rate = _RATE * min(1.0, (step + 1) / _WARMUP_STEPS, max(0.01, (1 - spent_s / whole_s) / (1 - _DECAYS_FROM)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        inputs, places_BQ = lessons.batch(np.random.default_rng((_SEED, step)))
        _, scores_BQS = model.pointing(inputs)
        loss = F.cross_entropy(scores_BQS.flatten(0, 1), places_BQ.flatten(), ignore_index=IGNORE)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learning, 1.0)
        optimiser.step()
        now_s = time.process_time()
        step, spent_s, since_s = step + 1, spent_s + now_s - since_s, now_s
        if spent_s - reported_s > _REPORT_EVERY_S or spent_s >= whole_s:
            reported_s = spent_s
            by_place, by_name = (hits(model, held_out, share) for share in (1.0, 0.0))
            found = f"hits by place {by_place:.2f}, by name where one can be told {by_name:.2f}"
            yield f"{spent_s / 60:.1f} min, step {step}, loss {loss.item():.3f}; {found}"
            since_s = time.process_time()
    model.requires_grad_(True)


def hits(model: Pounce, lessons: Lessons, placed_share: float, num_batches: int = 4) -> float:
    """Share of texts whose patch, or one beside it, has the highest score."""
    found = []
    side = round(model.config.pi05.vision.num_patches**0.5)
    for number in range(num_batches):
        inputs, places_BQ = lessons.batch(np.random.default_rng((_SEED + 1, number)), placed_share=placed_share)
        with torch.no_grad():
            _, scores_BQS = model.pointing(inputs)
        is_told_BQ = places_BQ != IGNORE
        chosen, wanted = scores_BQS.argmax(dim=-1)[is_told_BQ], places_BQ[is_told_BQ]
        away = torch.maximum((chosen // side - wanted // side).abs(), (chosen % side - wanted % side).abs())
        found += (away <= 1).tolist()
    return float(np.mean(found))


if __name__ == "__main__":
    sys.exit(main())
