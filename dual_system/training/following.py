"""``pp-follow``: cognition that moves with the thing that it points at.

A PONDER from scratch remembers where its thing was lit or named and does not look again: a thing that was pushed is
sought where it no longer is. To look again takes two steps, one that recalls the place and one that searches the
newest picture near it, and hundreds of steps of training on things that had moved did not find the second. So it is
laid out by hand once, as eyes are opened once (`pp-see`), and then trained on like everything else. Two layers are
added (`growing`), and two heads of the last attention are set by least squares on what that layer reads:

- the keys and values of an image token hold the place of the thing whose middle it shows, as `place_features`;
- one head asks for things near the place in C, roughly, and for the newest picture;
- the other asks for things at that very place, in whichever picture;
- C is moved by the first one's answer less the second one's: by nothing while nothing has moved.

Only for networks that carry places in the form of `stand_in`, as the recipe `small` teaches. The paper has nothing of
it.
"""

# H hidden size, D a head's size, P numbers that tell a place

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from clock import sampling
from dual_system.data.errors import DatasetError
from dual_system.models.place_code import NUM_PLACE_FEATURES, wave_columns
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.training.augment import Augmentation
from dual_system.training.collate import collate_ponder
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.growing import grown
from dual_system.training.joint import encode_rows
from dual_system.training.seeing import answers_of, names_in

DONE, REFUSED = 0, 2
_COARSE = [*wave_columns(128), *wave_columns(64)]
_FINE = wave_columns(32)
_FINE_WEIGHT = 0.7
_NEWEST = (2.0, 2.8)  # how much being near in time counts, by the two fastest rotations; a coarse place counts 2.8
_NOTHING = 4.0  # of a token without a thing, in a direction that nobody asks for
_GAIN = 3.0  # of queries and of keys
_OPEN, _SHUT = 4.0, -8.0  # gates, at carriers and elsewhere: sigmoid 0.98 and 0.0003
_THINGS_WEIGH, _CARRIERS_WEIGH = 3.0, 30.0  # against other tokens, of which there are many more
_RIDGE = 1.0
_VIEWS_PER_PAGE = 5
_NUM_OTHERS = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowOptions:
    """Gives a small PONDER two more layers, laid out so that cognition follows things that move."""

    ponder: Path
    """A folder of recipe `small`, its eyes open (`pp-see --ponder`)."""
    album: Path
    """A folder that pp-album made: what image tokens show."""
    data: tuple[Path, ...]
    """Folders of episodes with words, of pp-collect or pp-wander: what carriers hold."""
    out: Path
    """OUT/ponder is written."""
    episodes: int = 60
    """Read of each folder."""
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """What the last attention reads, and what it should make of it."""

    things_NH: Tensor
    """Image tokens that show a thing's middle."""
    places_NP: Tensor
    carriers_MH: Tensor
    pointing_MP: Tensor
    """The place that C tells already."""
    others_OH: Tensor
    """All other tokens."""
    hidden_rms: float
    """Of a carrier before the last norm: C is its share of that."""
    own_distance: int
    """In positions, from a carrier back to its own picture, as a rule."""


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(FollowOptions, args=argv, prog="pp-follow", description=FollowOptions.__doc__)
    try:
        follow(options)
    except (DatasetError, OSError, ValueError) as error:
        sys.stderr.write(f"pp-follow: {error}\n")
        return REFUSED
    sys.stdout.write(f"{options.out / 'ponder'}; it follows roughly, and has to be trained on\n")
    return DONE


def follow(options: FollowOptions) -> None:
    """Writes the larger PONDER.

    Raises:
        DatasetError, ValueError, OSError: what was given does not fit; the message says why.
    """
    if (options.out / "ponder").exists():
        raise ValueError(f"{options.out} holds a PONDER already; use another --out")
    ponder = grown(load_ponder(options.ponder))
    sight = Sight(form=ponder.format, pounce_px=None)
    album = TrainingSet(options.album, sight=sight)
    folders = [TrainingSet(folder, sight=sight) for folder in options.data]
    lay_out(ponder, samples_of(ponder, album, folders, options.episodes, options.seed))
    save_ponder(ponder, options.out / "ponder")


@torch.inference_mode()
def samples_of(
    ponder: Ponder, album: TrainingSet, folders: Sequence[TrainingSet], num_episodes: int, seed: int
) -> Samples:
    """Reads an album and the first episodes of other folders through all layers but the last one's attention.

    Raises ValueError if the album names nothing, or no episode has a query.
    """
    names = names_in(text for number in range(len(album)) for text in album[number].subgoals)
    things, places, others, carriers, pointing, rms, distances = [], [], [], [], [], [], []
    with _listening(ponder) as (read, hidden):
        for example in _views(ponder, album, seed):
            _, is_image_T = _encoded(ponder, example)
            tokens_NSH = read()[is_image_T].unflatten(0, (-1, ponder.format.num_image_tokens))
            texts = [example.view.text(example.episode.subgoals[query.tick]) for query in example.schedule.queries]
            spots = answers_of(texts, [""] * len(texts), names, ponder.format).things
            things.append(tokens_NSH[spots.is_here_NS])
            places.append(spots.told_NSP[spots.is_here_NS])
            others += [tokens_NSH[~spots.is_here_NS], read()[~is_image_T]]
        config = ExampleConfig(clocks=sampling.ROBOMME, max_invocations=1, has_foresight=True)
        for data in folders:
            for number in range(min(num_episodes, len(data))):
                example = make_example(data[number], ponder.format, config, np.random.default_rng([seed, number]))
                cognition_QH, is_image_T = _encoded(ponder, example)
                row = example.row()
                index_Q = torch.from_numpy(row.carrier_index[:, 0])
                carriers.append(read()[index_Q])
                pointing.append(cognition_QH[:, :NUM_PLACE_FEATURES])
                rms.append(hidden()[index_Q].square().mean(-1).sqrt())
                is_other_T = ~is_image_T
                is_other_T[index_Q] = False
                others.append(read()[is_other_T])
                positions_T = torch.from_numpy(ponder.format.positions(row.ids)[0][1])
                own_Q = torch.where(is_image_T)[0].unflatten(0, (len(index_Q), -1))[:, 0]
                distances.append(positions_T[index_Q] - positions_T[own_Q])
    if not carriers:
        raise ValueError("no episode was given for what carriers hold")
    others_OH = torch.cat(others)
    some = torch.randperm(len(others_OH), generator=torch.Generator().manual_seed(seed))[:_NUM_OTHERS]
    return Samples(
        things_NH=torch.cat(things),
        places_NP=torch.cat(places),
        carriers_MH=torch.cat(carriers),
        pointing_MP=torch.cat(pointing),
        others_OH=others_OH[some],
        hidden_rms=torch.cat(rms).mean().item(),
        own_distance=int(torch.cat(distances).mode().values),
    )


@torch.no_grad()
def lay_out(ponder: Ponder, samples: Samples) -> None:
    """Sets the last layer's attention.

    Raises ValueError if the last layer attends to no past, has fewer than two heads on one key, or they are too small.
    """
    language: Any = ponder.qwen.model.language_model
    layer = language.layers[-1]
    if not hasattr(layer, "self_attn"):
        raise ValueError("the last layer has no attention to lay out; full_attention_every must divide the layers")
    attention = layer.self_attn
    size, groups = attention.head_dim, attention.num_key_value_groups
    rotated = 2 * len(language.rotary_emb.inv_freq)
    nothing = rotated + len(_COARSE) + len(_FINE)
    if groups < 2 or size < max(nothing + 1, NUM_PLACE_FEATURES):
        raise ValueError(f"heads of {size} numbers, {groups} on a key; at least {nothing + 1} and 2 are needed")
    coarse, fine = slice(rotated, rotated + len(_COARSE)), slice(rotated + len(_COARSE), nothing)
    things, carriers, others = samples.things_NH, samples.carriers_MH, samples.others_OH
    heads = attention.q_proj.weight.unflatten(0, (-1, 2, size))  # a query and a gate each
    keys = attention.k_proj.weight.unflatten(0, (-1, size))
    values = attention.v_proj.weight.unflatten(0, (-1, size))

    wanted = torch.zeros(len(things) + len(others) + len(carriers), size)
    wanted[: len(things), : len(_NEWEST)] = torch.tensor(_NEWEST)
    wanted[: len(things), coarse] = samples.places_NP[:, _COARSE]
    wanted[: len(things), fine] = _FINE_WEIGHT * samples.places_NP[:, _FINE]
    wanted[len(things) :, nothing] = _NOTHING
    at_things = _reader(torch.cat([things, others, carriers]), len(things), _THINGS_WEIGH)
    keys[0] = at_things(wanted)
    wanted = torch.zeros_like(wanted)
    wanted[: len(things), :NUM_PLACE_FEATURES] = samples.places_NP
    values[0] = at_things(wanted)

    at_carriers = _reader(torch.cat([carriers, others, things]), len(carriers), _CARRIERS_WEIGH)
    asked = torch.zeros(len(carriers) + len(others) + len(things), size)
    asked[: len(carriers), coarse] = samples.pointing_MP[:, _COARSE]
    newest = asked.clone()
    for turn, strength in enumerate(_NEWEST):  # turned back by as much as its own picture lies behind
        angle = float(language.rotary_emb.inv_freq[turn]) * samples.own_distance
        newest[: len(carriers), turn] = strength * np.cos(angle)
        newest[: len(carriers), turn + rotated // 2] = -strength * np.sin(angle)
    asked[: len(carriers), fine] = _FINE_WEIGHT * samples.pointing_MP[:, _FINE]
    gate = torch.full((len(asked), 1), _SHUT)
    gate[: len(carriers)] = _OPEN
    for head, query in enumerate((newest, asked)):
        heads[head, 0] = at_carriers(query)
        heads[head, 1] = at_carriers(gate).expand(size, -1)
    attention.q_norm.weight.fill_(_GAIN - 1)  # Qwen3.5's norms count from one
    attention.k_norm.weight.fill_(_GAIN - 1)

    out = attention.o_proj.weight
    out.zero_()
    place = torch.arange(NUM_PLACE_FEATURES)
    per_number = samples.hidden_rms / (1 + language.norm.weight[:NUM_PLACE_FEATURES])
    out[place, place] = per_number
    out[place, size + place] = -per_number


def _reader(read_NH: Tensor, num_first: int, weight: float) -> Callable[[Tensor], Tensor]:
    """Least squares from what is read, the first tokens weighing more: wanted (N, D) to weights (D, H)."""
    weighed_NH = read_NH.clone()
    weighed_NH[:num_first] *= weight
    square_HH = weighed_NH.T @ read_NH + _RIDGE * torch.eye(read_NH.shape[1])
    return lambda wanted_ND: torch.linalg.solve(square_HH, weighed_NH.T @ wanted_ND).T


def _views(ponder: Ponder, album: TrainingSet, seed: int) -> Iterator[Example]:
    """Pages of an album as rows without words, each in several views."""
    config = ExampleConfig(
        clocks=sampling.ROBOMME,
        max_invocations=1,
        is_grounded=False,
        augmentation=Augmentation(max_shift_px=4, mirror=True),
    )
    for number in range(len(album)):
        for view in range(_VIEWS_PER_PAGE):
            yield make_example(album[number], ponder.format, config, np.random.default_rng([seed, number, view]))


def _encoded(ponder: Ponder, example: Example) -> tuple[Tensor, Tensor]:
    """C of every query (Q, H), of the first carrier, and which tokens are of images (T,)."""
    batch = collate_ponder([example])
    (hidden_TH,) = encode_rows(ponder, batch)
    row = batch.rows[0]
    is_image_T = torch.tensor(row.ids) == ponder.format.vocabulary.image_pad
    return hidden_TH[torch.from_numpy(row.carrier_index[:, 0])], is_image_T


@contextmanager
def _listening(ponder: Ponder) -> Iterator[tuple[Callable[[], Tensor], Callable[[], Tensor]]]:
    """What the last attention read in the latest row, (T, H), and what its layer made of it."""
    layer: Any = ponder.qwen.model.language_model.layers[-1]
    heard: dict[str, Tensor] = {}

    def hear(name: str) -> Callable[[Any, Any, Any], None]:
        return lambda module, given, made: heard.__setitem__(name, (made[0] if isinstance(made, tuple) else made)[0])

    hooks = [layer.input_layernorm.register_forward_hook(hear("read")), layer.register_forward_hook(hear("made"))]
    try:
        yield lambda: heard["read"], lambda: heard["made"]
    finally:
        for hook in hooks:
            hook.remove()


if __name__ == "__main__":
    sys.exit(main())
