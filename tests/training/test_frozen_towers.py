"""Training behind frozen vision towers: stored features give the losses and gradients that pictures give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.data.dataset import Dataset
from dual_system.models.pi05.modulation import NO_FRAME
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.training import recipes, train
from dual_system.training.build import Start
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.frozen_towers import FrozenTowers
from dual_system.training.joint import JointModel
from dual_system.training.parallel import World
from dual_system.training.recipe import Recipe
from dual_system.training.trainer import Trainer


def recipe_of(name: str) -> Recipe:
    run = recipes.recipe(name)
    return replace(
        run,
        ponder=replace(run.ponder, image_px=(64, 64), num_layers=4),
        example=replace(run.example, max_invocations=3),
        batch_episodes=2,
        freeze="vision",
        freezes_ponder_vision=True,
    )


def one_step(run: Recipe, folder: Path, store: Path, *, embeds: bool) -> tuple[JointModel, Trainer, Any]:
    model, bundle = train.build(run, TrainingSet(folder), Start())
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model), store=store)
    if embeds:
        data = data.embedded(FrozenTowers(model), World())
    batches = train.Batches(data, run, model, bundle, World())
    trainer = Trainer(model, batches, run.train)
    (report,) = trainer.run(1)
    return model, trainer, (report, batches(0))


@pytest.mark.parametrize("name", ["tiny", "tiny_framesamp", pytest.param("tiny_current", marks=pytest.mark.acceptance)])
def test_features_give_the_step_that_pictures_give(
    name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = recipe_of(name)
    _, _, (seen, (_, pictures)) = one_step(run, folder, tmp_path, embeds=False)
    _, _, (stored, (episodes, features)) = one_step(run, folder, tmp_path, embeds=True)
    assert stored.total == pytest.approx(seen.total, rel=2e-3)
    assert stored.gradient_norm == pytest.approx(seen.gradient_norm, rel=5e-3)
    assert (stored.num_supervised, stored.num_null) == (seen.num_supervised, seen.num_null)
    assert all(frames is None or frames.dtype == torch.float16 for frames in episodes.frames)
    assert isinstance(pictures.inputs, PounceInputs)
    assert isinstance(features.inputs, PounceInputs)
    assert torch.equal(features.inputs.has_view, pictures.inputs.has_view)
    if name == "tiny_framesamp":
        assert pictures.inputs.past_step is not None
        assert torch.equal(features.inputs.past_step, pictures.inputs.past_step)
        assert (pictures.inputs.past_step != NO_FRAME).any()

    def look(*_: Any, **__: Any) -> None:
        pytest.fail("a tower was asked again")

    monkeypatch.setattr(FrozenTowers, "features", look)
    _, _, (again, _) = one_step(run, folder, tmp_path, embeds=True)
    assert again == stored


def test_a_tower_that_learns_has_no_features_to_store(folder: Path) -> None:
    run = replace(recipe_of("tiny"), freezes_ponder_vision=False)
    model, _ = train.build(run, TrainingSet(folder), Start())
    with pytest.raises(ValueError, match="the recipe trains a vision tower"):
        FrozenTowers(model)


def test_other_towers_have_other_features(folder: Path, tmp_path: Path) -> None:
    run = recipe_of("tiny")
    model, _ = train.build(run, TrainingSet(folder), Start())
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model), store=tmp_path)
    first = data.embedded(FrozenTowers(model), World())[0]
    with torch.no_grad():
        for parameter in model.pounce.backbone.vision[0].parameters():
            parameter.mul_(1.5)
    second = data.embedded(FrozenTowers(model), World())[0]
    assert first.views[0][0].shape == second.views[0][0].shape
    assert not np.array_equal(first.views[0][0], second.views[0][0])
    assert np.array_equal(first.images[0][0], second.images[0][0])


def test_a_run_of_both_systems_finds_what_runs_of_either_stored(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = recipe_of("tiny")
    model, _ = train.build(run, TrainingSet(folder), Start())
    both = train._picture_sizes(run, model)
    for sizes in (PictureSizes(form=both.form), replace(both, form=None)):
        TrainingSet(folder, sizes=sizes, store=tmp_path).embedded(FrozenTowers(model), World())
    monkeypatch.setattr(FrozenTowers, "features", lambda *_: pytest.fail("a tower was asked again"))
    monkeypatch.setattr(Dataset, "views", lambda *_: pytest.fail("a video was decoded again"))
    episode = TrainingSet(folder, sizes=both, store=tmp_path).embedded(FrozenTowers(model), World())[0]
    assert {frame.dtype for frame in (*episode.views[0], *episode.images[0])} == {np.dtype(np.float16)}
    assert {frame.dtype for frame in TrainingSet(folder, sizes=both, store=tmp_path)[0].views[0]} == {
        np.dtype(np.uint8)
    }


def test_a_set_without_a_store_says_so(folder: Path) -> None:
    run = recipe_of("tiny")
    model, _ = train.build(run, TrainingSet(folder), Start())
    with pytest.raises(ValueError, match="give a --picture-store"):
        TrainingSet(folder, sizes=train._picture_sizes(run, model)).embedded(FrozenTowers(model), World())


def test_a_damaged_file_of_features_is_not_read_as_pictures(folder: Path, tmp_path: Path) -> None:
    run = recipe_of("tiny")
    model, _ = train.build(run, TrainingSet(folder), Start())
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model), store=tmp_path)
    stored = data.embedded(FrozenTowers(model), World())
    for path in tmp_path.rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(OSError, match="no features of"):
        stored[0]


def test_several_processes_begin_at_different_episodes_and_find_what_others_stored(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = recipe_of("tiny")
    model, _ = train.build(run, TrainingSet(folder), Start())
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model), store=tmp_path)
    computed, features = list[int](), FrozenTowers.features

    def counted(self: FrozenTowers, system: str, views: Any) -> Any:
        if system == "pounce":
            computed.append(len(views))
            if len(computed) == 1:  # the second of two processes; while it computes, the first one runs
                data.embedded(FrozenTowers(model), World())
        return features(self, system, views)

    monkeypatch.setattr(FrozenTowers, "features", counted)
    data.embedded(FrozenTowers(model), World(rank=1, size=2))
    ours, first, again = computed
    assert ours == again != first, "it begins with the second episode, and the first one is stored by then"
