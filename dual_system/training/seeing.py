"""``pp-see``: a vision tower from scratch learns what stands where, from an album (`pp-album`).

A pretrained PONDER brings eyes along. One from scratch would have to learn to see from the few places that it is told
to say, through a language model that is as new: slow, and never precise. Here every image token is asked directly: does
a thing's middle lie in your square, which one is it, and where is it, in the square and in the picture? The place in
the picture is asked for in the form that cognition will have (`stand_in`), for attention passes on what a token holds
and not where it stood. The robot's tool is asked for apart, since it is where things are: in a demonstration nothing
else tells what is being done. The answers come from one linear layer that is thrown away afterwards, so that a token
carries them plainly. No other recipe needs this, the paper has nothing of it, and no word is learned: the rest of
PONDER stays as it was drawn.
"""

# N pictures, S image tokens of a picture, W names, P numbers that tell a place

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from dual_system.data.errors import DatasetError
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.augment import Augmentation, draw_view
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.optim import OptimConfig, Optimiser
from dual_system.training.places import PLACE, TEXT_PX
from dual_system.training.recipe import stages_of
from dual_system.training.recipes import recipe

DONE, REFUSED = 0, 2

_THING = re.compile(r"([^,<>]+?) at <(\d+), (\d+)>")
_WAYS = Augmentation(max_shift_px=4, mirror=True)
_HELD_OUT_SHARE = 0.05
_EXAMINED_TOGETHER = 200
_PLACE_WEIGHT, _TOLD_WEIGHT, _NAME_WEIGHT = 16.0, 0.5, 0.3
_NUM_ASKED = 3 + NUM_PLACE_FEATURES  # of a thing, and of the tool: is it here, and where in two ways
_NUM_ANSWERS = 2 * _NUM_ASKED  # beside names
_ALIKE_WEIGHT = 10.0
_ALIKE_EPISODES, _ALIKE_PICTURES = 400, 8  # of one episode
_SETTLING_RATE = 1e-2
_SETTLING_STREAM = 1  # of a step's random numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class SeeOptions:
    """Teaches the vision tower of a recipe's PONDER to find and name things. A killed run begins anew."""

    recipe: str
    """Which PONDER: small."""
    data: tuple[Path, ...]
    """Folders that pp-collect made: PONDER's tokenizer is trained on their texts, as pp-train would."""
    album: tuple[Path, ...]
    """Folders that pp-album made."""
    ponder: Path | None = None
    """Open the eyes of this one again, all else as it is; --recipe is then not read, and --data for --like alone."""
    like: Path | None = None
    """The one whose eye was widened to that of --ponder, or --ponder itself: what it saw is to be seen as it was.
    Pictures of --data's episodes are read for that."""
    out: Path
    """OUT/ponder is what `pp-train --ponder` goes on from."""
    steps: int = 2000
    settling: int = 0
    """Before these so many steps in which the questions are learned and not the eyes. With --ponder: what it can read
    already then stays near what it was."""
    pictures: int = 128
    """Of one step."""
    learning_rate: float = 2e-3
    seed: int = 0
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Album:
    """Pictures as PONDER's eye sees them, and what is in each."""

    pictures: NDArray[np.uint8]
    """(N, height, width, 3)"""
    texts: tuple[str, ...]
    tools: tuple[str, ...]
    """Where the tool is, ``<y, x>``."""
    names: tuple[str, ...]
    """Of all things, sorted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spots:
    """Where the image tokens of pictures should say that something is."""

    is_here_NS: Tensor
    """bool"""
    place_NS2: Tensor
    """Down and right in a token's square, -1/2 to 1/2."""
    told_NSP: Tensor
    """The place in the picture, as `place_features`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answers:
    """What the image tokens of pictures should say."""

    things: Spots
    name_NS: Tensor
    """int64, where there is a thing."""
    tool: Spots


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(SeeOptions, args=argv, prog="pp-see", description=SeeOptions.__doc__)
    try:
        see_things(options)
    except (DatasetError, OSError, ValueError, FloatingPointError) as error:
        sys.stderr.write(f"pp-see: {error}\n")
        return REFUSED
    return DONE


def see_things(options: SeeOptions) -> None:
    """Trains, says how well pictures that were held out are seen, and writes PONDER.

    Raises:
        DatasetError, ValueError, OSError: what was given does not fit; the message says why.
        FloatingPointError: the gradients are not finite.
    """
    if (options.out / "ponder").exists():
        raise ValueError(f"{options.out} holds a PONDER already; use another --out")
    ponder = _newborn(options) if options.ponder is None else load_ponder(options.ponder)
    album = read_album(ponder.format, *options.album)
    num_held_out = max(1, round(_HELD_OUT_SHARE * len(album.texts)))
    num_learned = len(album.texts) - num_held_out
    if num_learned < 1:
        folders = ", ".join(map(str, options.album))
        raise ValueError(f"{folders}: {len(album.texts)} pictures; some hundreds at least are needed")
    before = None if options.like is None else _before(options.like, ponder)
    films = None if before is None else _films(ponder.format, options.data, options.seed)
    torch.manual_seed(options.seed)
    answering = nn.Linear(ponder.hidden_size, _NUM_ANSWERS + len(album.names))
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "log.jsonl").open("w") as log:
        settling = _phase(answering, options.settling, _SETTLING_RATE)
        opening = _phase(nn.ModuleList([ponder.qwen.model.visual, answering]), options.steps, options.learning_rate)
        for step in tqdm(range(-options.settling, options.steps), unit="step", disable=not options.progress):
            is_opening = step >= 0
            rng = np.random.default_rng([options.seed, step] if is_opening else [options.seed, -step, _SETTLING_STREAM])
            chosen = rng.integers(num_learned, size=options.pictures)
            frames_NHW3, answers = draw(album, chosen, ponder.format, rng)
            with torch.set_grad_enabled(is_opening):
                tokens = ponder.image_features(frames_NHW3)
            loss = loss_of(answering(tokens), answers)
            if before is not None and films is not None and is_opening:
                filmed = torch.from_numpy(films[rng.integers(len(films), size=options.pictures // 2)])
                loss = loss + _ALIKE_WEIGHT * unlikeness(ponder, before, filmed)
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser, done = (opening, step) if is_opening else (settling, step + options.settling)
            optimiser.update(done)
            log.write(json.dumps({"step": step, "loss": loss.item()}) + "\n")
    held_out = np.arange(num_learned, len(album.texts))
    sys.stdout.write(f"{num_held_out} pictures held out: {examine(ponder, answering, album, held_out)}\n")
    save_ponder(ponder, options.out / "ponder")


def unlikeness(ponder: Ponder, before: Ponder, frames_NHW3: Tensor) -> Tensor:
    """How much ``ponder`` shows otherwise than ``before`` did, of its part of these pictures; 1 is the variance."""
    first_token = _first_token(ponder, before)
    assert first_token is not None
    top, left = (first * ponder.format.token_px for first in first_token)
    height, width = before.image_px
    with torch.no_grad():
        wanted = before.image_features(frames_NHW3[:, top : top + height, left : left + width].contiguous())
    tokens_NSH = ponder.image_features(frames_NHW3).unflatten(0, (len(frames_NHW3), -1))
    shown = tokens_NSH[:, : before.format.num_image_tokens].flatten(0, 1)
    return (shown - wanted).square().mean() / (wanted - wanted.mean(dim=0)).square().mean()


def _before(like: Path, ponder: Ponder) -> Ponder:
    before = load_ponder(like)
    if _first_token(ponder, before) is None:
        raise ValueError(
            f"{like} sees {before.format.image_grid} tokens of {before.format.token_px} px; it must see the same as "
            f"--ponder, which sees {ponder.format.image_grid}, or be what was widened to a fovea of "
            f"{ponder.format.fovea}; tokens of {ponder.format.token_px} px"
        )
    return before


def _first_token(ponder: Ponder, before: Ponder) -> tuple[int, int] | None:
    """Row and column, among the tokens of ``ponder``, of the first that ``before`` sees; None: no such part."""
    fovea, grid = ponder.format.fovea, before.format.image_grid
    if ponder.format.token_px != before.format.token_px:
        return None
    if grid == ponder.format.image_grid:
        return 0, 0
    return fovea[:2] if fovea is not None and fovea[2:] == grid else None


def _films(form: ContextFormat, folders: Sequence[Path], seed: int) -> NDArray[np.uint8]:
    """Pictures of episodes, (N, height, width, 3)."""
    episodes = TrainingSet(*folders, sight=Sight(form=form, pounce_px=None))
    rng = np.random.default_rng(seed)
    pictures: list[NDArray[np.uint8]] = []
    for number in rng.permutation(len(episodes))[:_ALIKE_EPISODES]:
        sights = episodes[int(number)].sights or ()
        pictures += [sights[tick][0] for tick in rng.integers(len(sights), size=_ALIKE_PICTURES)]
    return np.stack(pictures)


def _phase(learning: nn.Module, num_steps: int, rate: float) -> Optimiser:
    decay = (num_steps // 2, max(num_steps, 1))
    return Optimiser(learning, OptimConfig(learning_rate=rate, weight_decay=1e-4, decay=decay))


def _newborn(options: SeeOptions) -> Ponder:
    """The recipe's, as it is drawn."""
    run = stages_of(recipe(options.recipe))[0]
    if not run.from_scratch:
        raise ValueError(f"recipe {run.name} starts from pretrained weights, which can see; pp-see is for small")
    texts = TrainingSet(*options.data).texts()
    vocabulary = Vocabulary.trained_on(texts, run.ponder.first_carrier_id) if run.has_own_tokenizers else None
    return Ponder.random(run.ponder, vocabulary, seed=options.seed)


def read_album(form: ContextFormat, *folders: Path) -> Album:
    """All pictures of the folders, mixed. Raises DatasetError if it is none, ValueError if its texts name nothing."""
    if form.eyes is None or len(form.eyes) != 1 or form.eyes[0].camera != 0:
        raise ValueError("things are placed in the front camera's picture: PONDER needs one eye, on that camera")
    pages = TrainingSet(*folders, sight=Sight(form=form, pounce_px=None))
    pictures: list[NDArray[np.uint8]] = []
    texts: list[str] = []
    tools: list[str] = []
    for number in range(len(pages)):
        page = pages[number]
        pictures += [sight[0] for sight in page.sights or ()]
        texts += page.subgoals
        tools += pages.tools(number)
    try:
        names = names_in(texts)
    except ValueError as error:
        raise ValueError(f"{', '.join(map(str, folders))}: {error}; make it with pp-album") from None
    # one album's pictures stay as they lie, of several each has its share of what is held out, at the end
    order = np.arange(len(texts)) if len(folders) == 1 else np.random.default_rng(0).permutation(len(texts))
    return Album(
        pictures=np.stack([pictures[i] for i in order]),
        texts=tuple(texts[i] for i in order),
        tools=tuple(tools[i] for i in order),
        names=names,
    )


def names_in(texts: Iterable[str]) -> tuple[str, ...]:
    """What an album's texts call things, sorted. Raises ValueError if they name nothing."""
    names = {found[1].strip() for text in texts for found in _THING.finditer(text)}
    if not names:
        raise ValueError("no text names a thing and its place")
    return tuple(sorted(names))


def draw(
    album: Album, chosen: NDArray[np.integer], form: ContextFormat, rng: np.random.Generator, ways: Augmentation = _WAYS
) -> tuple[Tensor, Answers]:
    """Pictures by number, each moved and mirrored in its own way: (N, height, width, 3) uint8, and the answers."""
    frames, told, tools = [], [], []
    for number in chosen:
        view = draw_view(ways, form, set(), rng)
        frames.append(view.pictures(torch.from_numpy(album.pictures[number])[None]))
        told.append(view.text(album.texts[number]))
        tools.append(view.text(album.tools[number]))
    return torch.cat(frames), answers_of(told, tools, album.names, form)


def answers_of(texts: Sequence[str], tools: Sequence[str], names: Sequence[str], form: ContextFormat) -> Answers:
    """Which token's square holds which thing's middle; of several in one square, the last. Others are not asked for.

    ``tools``: where the tool is in each picture, ``<y, x>``; empty where nobody asks.
    """
    found: list[list[tuple[float, float]]] = []
    name_NS = torch.zeros(len(texts), form.image_grid[0] * form.image_grid[1], dtype=torch.int64)
    for number, text in enumerate(texts):
        found.append([])
        for name, y, x in _THING.findall(text):
            found[-1].append((int(y), int(x)))
            if (at := _square(found[-1][-1], form)) is not None:
                name_NS[number, at[0]] = names.index(name.strip())
    tool = [[(int(y), int(x)) for y, x in PLACE.findall(text)] for text in tools]
    return Answers(things=_spots(found, form), name_NS=name_NS, tool=_spots(tool, form))


def _square(yx_px: tuple[float, float], form: ContextFormat) -> tuple[int, float, float] | None:
    """The token in whose square a place lies, and how far down and right of its middle; None if PONDER sees it not."""
    assert form.eyes is not None
    top, left, bottom, right = form.eyes[0].box
    num_rows, num_columns = form.image_grid
    down = (yx_px[0] / TEXT_PX - top) / (bottom - top) * num_rows
    along = (yx_px[1] / TEXT_PX - left) / (right - left) * num_columns
    if not (0 <= down < num_rows and 0 <= along < num_columns):
        return None
    token = int(np.flatnonzero(form.token_order == int(down) * num_columns + int(along))[0])
    return token, down % 1 - 0.5, along % 1 - 0.5


def _spots(places_N: Sequence[Sequence[tuple[float, float]]], form: ContextFormat) -> Spots:
    shape = (len(places_N), form.image_grid[0] * form.image_grid[1])
    is_here_NS = torch.zeros(shape, dtype=torch.bool)
    place_NS2, told_NSP = torch.zeros(*shape, 2), torch.zeros(*shape, NUM_PLACE_FEATURES)
    for number, places in enumerate(places_N):
        for place in places:
            if (at := _square(place, form)) is not None:
                token, *offset = at
                is_here_NS[number, token] = True
                place_NS2[number, token] = torch.tensor(offset)
                told_NSP[number, token] = torch.from_numpy(place_features(place))
    return Spots(is_here_NS=is_here_NS, place_NS2=place_NS2, told_NSP=told_NSP)


def loss_of(said: Tensor, answers: Answers) -> Tensor:
    """Of the answers (N * S, 2 * (3 + P) + W): is there a thing, and where there is, its place in both ways and its
    name; is the tool there, and where."""
    is_thing = answers.things.is_here_NS.flatten()
    named = F.cross_entropy(said[is_thing, _NUM_ANSWERS:], answers.name_NS.flatten()[is_thing])
    loss = _located(said[:, :_NUM_ASKED], answers.things) + _NAME_WEIGHT * named
    # where it is in no picture nobody asks for it
    has_tool = bool(answers.tool.is_here_NS.any())
    return loss + _located(said[:, _NUM_ASKED:_NUM_ANSWERS], answers.tool) if has_tool else loss


def _located(said: Tensor, spots: Spots) -> Tensor:
    is_here = spots.is_here_NS.flatten()
    found = F.binary_cross_entropy_with_logits(said[:, 0], is_here.float())
    placed = F.mse_loss(said[is_here, 1:3], spots.place_NS2.flatten(0, 1)[is_here])
    told = F.mse_loss(said[is_here, 3:], spots.told_NSP.flatten(0, 1)[is_here])
    return found + _PLACE_WEIGHT * placed + _TOLD_WEIGHT * told


@torch.inference_mode()
def examine(ponder: Ponder, answering: nn.Linear, album: Album, chosen: NDArray[np.integer]) -> str:
    """How well these pictures are seen as they are, in words; places in pixels of the 256 px picture."""
    rng = np.random.default_rng(0)
    said, there = [], []
    for some in np.array_split(chosen, -(-len(chosen) // _EXAMINED_TOGETHER)):
        frames_NHW3, answers = draw(album, some, ponder.format, rng, Augmentation())
        said.append(answering(ponder.image_features(frames_NHW3)))
        there.append(answers)
    is_thing = torch.cat([each.things.is_here_NS.flatten() for each in there])
    names = torch.cat([each.name_NS.flatten() for each in there])[is_thing]
    named = (torch.cat(said)[is_thing, _NUM_ANSWERS:].argmax(-1) == names).float().mean().item()
    things = _how_well([each[:, :_NUM_ASKED] for each in said], [each.things for each in there], ponder.format)
    tool = _how_well([each[:, _NUM_ASKED:] for each in said], [each.tool for each in there], ponder.format)
    return f"of their things {things}, {named:.1%} named rightly; of their tools {tool}"


def _how_well(said: Sequence[Tensor], spots: Sequence[Spots], form: ContextFormat) -> str:
    assert form.eyes is not None
    is_here = torch.cat([each.is_here_NS.flatten() for each in spots])
    if not is_here.any():
        return "none"
    answers = torch.cat(list(said))[is_here]
    top, left, bottom, right = form.eyes[0].box
    num_rows, num_columns = form.image_grid
    token_px = torch.tensor([(bottom - top) / num_rows, (right - left) / num_columns]) * TEXT_PX
    places = torch.cat([each.place_NS2.flatten(0, 1) for each in spots])[is_here]
    off_px = ((answers[:, 1:3] - places) * token_px).norm(dim=-1)
    p50, p95 = off_px.quantile(torch.tensor([0.5, 0.95])).tolist()
    found = (answers[:, 0] > 0).float().mean().item()
    return f"{found:.1%} found, {p50:.2f} px off (p95 {p95:.2f})"


if __name__ == "__main__":
    sys.exit(main())
