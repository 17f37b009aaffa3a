"""The two heads as they are laid out: C moves by as much as its thing did, and stays where nothing moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.data import album, wander
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features, wave_columns
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.following import REFUSED, Samples, lay_out, main, samples_of

SIZE = 128
RMS = 10.0
GRID = [(y, x) for y in range(0, 160, 2) for x in range(40, 220, 2)]
CODES = torch.from_numpy(np.stack([place_features(place) for place in GRID]))
THING, CARRIER, OTHER = 60, 61, 62  # directions that say what a token is


def code(place: tuple[int, int]) -> Tensor:
    return torch.from_numpy(place_features(place).copy())


def token(kind: int, first: int, places_NP: Tensor) -> Tensor:
    """What a layer reads of tokens of a kind, their places in numbers of their own."""
    read = 0.1 * torch.randn(len(places_NP), SIZE, generator=torch.Generator().manual_seed(kind))
    read[:, :63] = 0.0
    read[:, first : first + NUM_PLACE_FEATURES] = places_NP
    read[:, kind] = 3.0
    return read


def things(places_NP: Tensor) -> Tensor:
    return token(THING, 0, places_NP)


def carriers(places_NP: Tensor) -> Tensor:
    return token(CARRIER, 30, places_NP)


def others(count: int) -> Tensor:
    return token(OTHER, 0, torch.zeros(count, NUM_PLACE_FEATURES))


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    made = Ponder.random(ponder_configs.small(), seed=1)
    some = torch.from_numpy(np.random.default_rng(0).choice(len(GRID), 1000))
    ids, _ = row(made)
    positions = positions_of(made, ids)[1]
    pictures = torch.where(ids == made.format.vocabulary.image_pad)[0]
    lay_out(
        made,
        Samples(
            things_NH=things(CODES[some]),
            places_NP=CODES[some],
            carriers_MH=carriers(CODES[some]),
            pointing_MP=CODES[some],
            others_OH=others(2000),
            hidden_rms=RMS,
            own_distance=int(positions[-1] - positions[pictures[-1]]),
        ),
    )
    return made


def row(ponder: Ponder, num_queries: int = 3) -> tuple[Tensor, Tensor]:
    form = ponder.format
    segments = [segment for _ in range(num_queries) for segment in form.query(1, None, np.zeros(8, np.float32))]
    laid = form.row(segments)
    return torch.tensor(laid.ids), torch.from_numpy(laid.carrier_index[:, 0])


def positions_of(ponder: Ponder, ids: Tensor) -> Tensor:
    return torch.from_numpy(ponder.format.positions(ids.tolist())[0])


@torch.no_grad()
def moves(ponder: Ponder, told: tuple[int, int], seen: list[list[tuple[int, int]]]) -> Tensor:
    """By how much C is moved at the last carrier, when these things were seen at one query after the other."""
    ids, carrier_index = row(ponder, len(seen))
    read = others(len(ids))
    is_image = ids == ponder.format.vocabulary.image_pad
    for places, tokens in zip(seen, torch.where(is_image)[0].unflatten(0, (len(seen), -1)), strict=True):
        for index, place in zip(tokens.tolist(), places, strict=False):
            read[index] = things(code(place)[None])[0]
    read[carrier_index] = carriers(code(told).expand(len(seen), -1))
    language = ponder.qwen.model.language_model
    turned = language.rotary_emb(read[None], positions_of(ponder, ids)[1:, None])
    made, _ = language.layers[-1].self_attn(read[None], turned, None)
    return made[0, -1, :NUM_PLACE_FEATURES] * (1 + language.norm.weight[:NUM_PLACE_FEATURES]) / RMS


PLACES = st.tuples(st.integers(40, 120), st.integers(80, 170))


@settings(max_examples=40, deadline=None)
@given(told=PLACES, by=st.tuples(st.integers(-8, 8), st.integers(-8, 8)))
def test_c_moves_with_its_thing_and_not_with_another(
    ponder: Ponder, told: tuple[int, int], by: tuple[int, int]
) -> None:
    other = (told[0] + 34, told[1] - 30)
    now = (told[0] + by[0], told[1] + by[1])
    moved = code(told) + moves(ponder, told, [[told, other], [told, other], [now, (other[0] - 3, other[1] + 4)]])
    nearest = GRID[int((CODES - moved).square().sum(1).argmin())]
    assert np.hypot(nearest[0] - now[0], nearest[1] - now[1]) <= 3


@settings(max_examples=20, deadline=None)
@given(told=PLACES)
def test_c_stays_where_nothing_moved_and_where_nothing_is_seen(ponder: Ponder, told: tuple[int, int]) -> None:
    other = (told[0] + 34, told[1] - 30)
    still = moves(ponder, told, [[told, other]] * 3)
    hidden = moves(ponder, told, [[told, other], [told, other], []])
    assert still.abs().max() < 0.2
    assert hidden.abs().max() < 0.2


def test_columns_are_the_waves_of_their_period() -> None:
    for period in (512, 256, 128, 64, 32, 16):
        columns = wave_columns(period)
        here, further = code((100, 90))[columns], code((100 - period, 90 + period))[columns]
        torch.testing.assert_close(here, further, atol=1e-4, rtol=0)
        half = code((100 + period // 2, 90 - period // 2))[columns]
        torch.testing.assert_close(here, -half, atol=1e-4, rtol=0)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("page")
    assert album.main(["--out", str(out), "--pictures", "100", "--image-px", "128", "--no-progress"]) == 0
    return out


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("films")
    size = ["--episodes", "3", "--looks", "5", "--image-px", "128"]
    assert wander.main(["--out", str(out), *size, "--no-progress"]) == 0
    return out


def test_a_folder_becomes_one_of_two_layers_more(
    page: Path, films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, out = tmp_path / "old", tmp_path / "out"
    save_ponder(Ponder.random(ponder_configs.small(), seed=0), old)
    arguments = ["--ponder", str(old), "--album", str(page), "--data", str(films), "--out", str(out)]
    assert main([*arguments, "--episodes", "2"]) == 0
    assert "has to be trained on" in capsys.readouterr().out
    layers = load_ponder(out / "ponder").qwen.model.language_model.layers
    assert len(layers) == ponder_configs.small().num_layers + 2
    out_HD = layers[-1].self_attn.o_proj.weight
    told = torch.zeros_like(out_HD, dtype=torch.bool)
    place = torch.arange(NUM_PLACE_FEATURES)
    told[place, place] = told[place, layers[-1].self_attn.head_dim + place] = True
    assert torch.equal(out_HD != 0, told)
    assert main(arguments) == REFUSED
    assert "another --out" in capsys.readouterr().err


def test_what_is_read_belongs_together(page: Path, films: Path) -> None:
    ponder = Ponder.random(ponder_configs.small(), seed=0)
    sight = Sight(form=ponder.format, pounce_px=None)
    read = samples_of(ponder, TrainingSet(page, sight=sight), [TrainingSet(films, sight=sight)], 2, 0)
    assert len(read.things_NH) == len(read.places_NP) > 100
    assert len(read.carriers_MH) == len(read.pointing_MP) >= 2 * 5  # a query a second, and some more
    ids, carrier_index = row(ponder)
    positions = positions_of(ponder, ids)[1]
    pictures = torch.where(ids == ponder.format.vocabulary.image_pad)[0].unflatten(0, (3, -1))[:, 0]
    assert read.own_distance == int((positions[carrier_index] - positions[pictures])[0])
    with pytest.raises(ValueError, match="no episode"):
        samples_of(ponder, TrainingSet(page, sight=sight), [], 2, 0)


def test_a_last_layer_without_attention_is_refused() -> None:
    odd = Ponder.random(replace(ponder_configs.small(), num_layers=3), seed=0)
    nothing = torch.zeros(0, SIZE)
    samples = Samples(
        things_NH=nothing,
        places_NP=nothing,
        carriers_MH=nothing,
        pointing_MP=nothing,
        others_OH=nothing,
        hidden_rms=1.0,
        own_distance=7,
    )
    with pytest.raises(ValueError, match="no attention to lay out"):
        lay_out(odd, samples)
