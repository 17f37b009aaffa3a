"""Texts about stills say where things are, and a prefix that learns from them points there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.context import IGNORE
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from dual_system.models.windows import LAPTOP_WINDOWS, placed_in
from dual_system.policy import pointing
from dual_system.policy.album import Album
from dual_system.policy.locating import Labels
from dual_system.policy.pointing import Lessons, main, trained
from dual_system.policy.studio import NAMES, WINDOWS
from dual_system.training.laptop_recipes import laptop_hand

_TABLE = Quantiles(q01=(-1.0,) * 7, q99=(1.0,) * 7)
STATISTICS = RobotStatistics(state=_TABLE, action=_TABLE, space="ee_delta")
NUM, MOST = 40, 3


@pytest.fixture
def bundle() -> PounceBundle:
    return random_bundle(laptop_hand().pounce, 0, statistics=STATISTICS)


def album(seed: int) -> Album:
    """Stills of one to three things; the last one has none."""
    rng = np.random.default_rng(seed)
    is_real = torch.from_numpy(rng.integers(1, MOST + 1, NUM)[:, None] > np.arange(MOST))
    is_real[-1] = False
    labels = Labels(
        place_BK2=torch.from_numpy(rng.uniform(0.01, 0.99, (NUM, MOST, 2))).float(),
        kind_BK=torch.from_numpy(rng.integers(0, 3, (NUM, MOST))),
        is_real_BK=is_real,
        position_BK3=torch.zeros(NUM, MOST, 3),
        turn_BK2=torch.zeros(NUM, MOST, 2),
    )
    return Album(pictures=torch.from_numpy(rng.integers(0, 256, (NUM, 64, 64, 3), dtype=np.uint8)), labels=labels)


def pictures() -> dict[str, Album]:
    return {camera: album(0) for camera in WINDOWS}


def model_of(bundle: PounceBundle) -> Pounce:
    assert isinstance(bundle.model, Pounce)
    return bundle.model


def test_a_text_says_the_place_of_what_its_patch_holds_or_a_kind_that_is_there_once(bundle: PounceBundle) -> None:
    lessons, labels, rng = Lessons(bundle, model_of(bundle), pictures()), album(0).labels, np.random.default_rng(0)
    kinds, away = set(), []
    for _ in range(300):
        still = int(rng.integers(NUM - 1))
        text, patches = lessons.lesson(still, rng, placed_share=0.5)
        parts = text.split(" to ")
        assert len(parts) == len(patches)
        for part, patch in zip(parts, patches, strict=True):
            here = labels.is_real_BK[still] & torch.tensor(
                [f"the {NAMES[int(k)]}" in part for k in labels.kind_BK[still]]
            )
            cells = (labels.place_BK2[still] * 8).long()
            holding = here & (8 * cells[:, 0] + cells[:, 1] == patch)
            assert holding.any()
            kinds.add(has_place := "[" in part)
            if has_place:
                x, y = (int(each) / 1000 for each in re.findall(r"\d+", part))
                told = torch.from_numpy(placed_in(LAPTOP_WINDOWS[0], (y, x)))
                away.append(float((labels.place_BK2[still][holding] - told).norm(dim=-1).min()))
            else:
                assert int(here.sum()) == 1
    assert kinds == {True, False}
    assert 0.01 < np.median(away) < 0.05, "3.2 px of 256, in a window of nine sixteenths"


def test_a_batch_is_padded_as_prompts_are_and_leaves_stills_without_things_out(bundle: PounceBundle) -> None:
    model = model_of(bundle)
    inputs, places_BQ = Lessons(bundle, model, pictures()).batch(np.random.default_rng(1))
    assert (places_BQ[:, 0] != IGNORE).all()
    assert {False, True} == set((places_BQ[:, 1] == IGNORE).tolist())
    longest = inputs.is_token.sum(dim=1).max()
    assert inputs.token_ids.shape == inputs.is_token.shape == (64, longest)
    _, scores_BQS = model.pointing(inputs)
    assert scores_BQS.shape == (64, 2, 64)


def test_training_moves_the_prefix_and_leaves_towers_and_expert(
    bundle: PounceBundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pointing, "_HELD_OUT", 8)
    model = model_of(bundle)
    before = {name: each.clone() for name, each in model.state_dict().items()}
    (line,) = trained(bundle, model, pictures(), minutes=0.01)
    assert "hits by place" in line
    moved = {name for name, each in model.state_dict().items() if not torch.equal(each, before[name])}
    assert {"pointer.score.weight", "pi05.language.embed_tokens.weight"} <= moved
    decayed = {"pi05.expert", "pi05.action", "pi05.time", "pointer.condition", "pointer.read"}
    assert not any(name.startswith(("pi05.vision", "pi05.projector", *decayed)) for name in moved)


def test_it_writes_a_folder_that_the_hand_starts_from(
    bundle: PounceBundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pointing, "_HELD_OUT", 8)
    monkeypatch.setattr(pointing, "albums", lambda *_: pictures())
    save_bundle(bundle, tmp_path / "towers" / "pounce")
    folders = ["--towers", str(tmp_path / "towers"), "--out", str(tmp_path / "out")]
    assert main([*folders, "--minutes", "0.001"]) == 0
    found = load_bundle(tmp_path / "out" / "pounce")
    assert found.model.config == bundle.model.config
    assert found.digest() != bundle.digest()
