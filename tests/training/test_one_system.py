"""A run trains both systems or one of them; what does not learn does not change, and what is not needed is not run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.training import joint, recipes, train
from dual_system.training.data import TrainingSet
from dual_system.training.joint import JointModel
from dual_system.training.parallel import World
from dual_system.training.recipe import Recipe
from dual_system.training.train import InsteadOptions, LogOptions, TrainOptions
from dual_system.training.trainer import StepReport, Trainer


def recipe_for(trains: joint.Trains, *, name: str = "tiny") -> Recipe:
    """``tiny`` has K = 1; ``tiny_subgoal_text`` has K = 0."""
    run = recipes.recipe(name)
    ponder = replace(run.ponder, image_px=(64, 64), num_layers=4)
    example = replace(run.example, max_invocations=2)
    return replace(run, name="one", ponder=ponder, example=example, batch_episodes=2, trains=trains)


def options(folder: Path, out: Path) -> TrainOptions:
    instead, log = InsteadOptions(steps=2), LogOptions(progress=False)
    return TrainOptions(recipe="one", data=(folder,), out=out, instead=instead, log=log)


def trainer_of(run: Recipe, folder: Path) -> Trainer:
    model, bundle = train.build(run, TrainingSet(folder), options(folder, folder / "unused").start)
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model))
    return Trainer(model, train.Batches(data, run, model, bundle, World()), run.train)


def changed(trainer: Trainer) -> tuple[set[str], list[StepReport]]:
    """Which systems two steps changed."""

    def weights(model: JointModel) -> dict[str, torch.Tensor]:
        return {name: parameter.detach().clone() for name, parameter in model.named_parameters()}

    before = weights(trainer.model)
    reports = list(trainer.run(2))
    moved = {name for name, now in weights(trainer.model).items() if not torch.equal(now, before[name])}
    return {name.split(".")[0] for name in moved}, reports


def not_run(*_: Any, **__: Any) -> None:
    pytest.fail("it was run")


def test_pounce_alone_learns_from_a_ponder_that_does_not_change(folder: Path) -> None:
    trainer = trainer_of(recipe_for("pounce"), folder)
    systems, reports = changed(trainer)
    assert systems == {"pounce"}
    assert all(parameter.grad is None for parameter in trainer.model.ponder.parameters())
    assert all(report.flow_matching > 0 for report in reports)
    assert [(report.grounding, report.num_supervised) for report in reports] == [(0.0, 0)] * 2
    episodes, _ = trainer.latest
    assert len(episodes.rows) == len(episodes.frames) == 2


def test_its_loss_is_that_of_both_and_its_gradient_too(folder: Path) -> None:
    """Alone POUNCE sees the very cognition that it would see beside a PONDER that learns."""
    alone, beside = trainer_of(recipe_for("pounce"), folder), trainer_of(recipe_for("both"), folder)
    losses = {}
    for trainer in (alone, beside):
        episodes, invocations = trainer._batches(0)
        loss = trainer.model(episodes, invocations, trainer._draws(invocations)).flow_matching
        weights = dict(trainer.model.pounce.named_parameters())
        found = torch.autograd.grad(loss, list(weights.values()), allow_unused=True)
        losses[trainer is alone] = loss.detach(), dict(zip(weights, found, strict=True))
    torch.testing.assert_close(losses[True], losses[False], rtol=0, atol=0)


def test_pounce_alone_without_cognition_does_without_ponder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("forward", "embed", "image_features", "logits"):
        monkeypatch.setattr(Ponder, name, not_run)
    trainer = trainer_of(recipe_for("pounce", name="tiny_subgoal_text"), folder)
    assert not trainer.model.runs_ponder
    assert (trainer._batches(0)[0].rows, trainer._batches(0)[0].frames) == ((), ())
    systems, reports = changed(trainer)
    assert systems == {"pounce"}
    assert all(report.flow_matching > 0 for report in reports)


def test_beside_a_pounce_without_cognition_ponder_learns_its_texts(folder: Path) -> None:
    systems, reports = changed(trainer_of(recipe_for("both", name="tiny_subgoal_text"), folder))
    assert systems == {"ponder", "pounce"}
    assert all(report.grounding > 0 for report in reports)


def test_ponder_alone_does_without_pounce(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint, "action_loss", not_run)
    trainer = trainer_of(recipe_for("ponder"), folder)
    systems, reports = changed(trainer)
    assert systems == {"ponder"}
    assert all(report.grounding > 0 for report in reports)
    assert [report.flow_matching for report in reports] == [0.0, 0.0]


@pytest.mark.parametrize("name", ["tiny", "tiny_groot"])
def test_a_prompt_that_pounce_cannot_read_is_found_before_the_first_step(name: str, folder: Path) -> None:
    run = recipe_for("both", name=name)
    short = replace(run, pounce=replace(run.pounce, max_prompt_tokens=3))
    with pytest.raises(ValueError, match=r"prompt has \d+ tokens, expected at most 3 .*shorten the instruction"):
        trainer_of(short, folder)


def test_ponder_alone_learns_from_tasks_that_pounce_cannot_read(folder: Path) -> None:
    run = recipe_for("ponder")
    trainer = trainer_of(replace(run, pounce=replace(run.pounce, max_prompt_tokens=40)), folder)
    twin = trainer_of(run, folder)
    assert [report.grounding for report in trainer.run(2)] == [report.grounding for report in twin.run(2)]


def test_ponder_alone_learns_from_episodes_that_nobody_imitates(folder: Path) -> None:
    """A correction may begin after the last invocation of its schedule."""
    trainer = trainer_of(recipe_for("ponder"), folder)
    data = trainer._batches._data
    late = [replace(data[number], imitated_from=data[number].num_ticks - 1) for number in range(len(data))]
    data._cache.update(enumerate(late))
    (report,) = trainer.run(1)
    assert report.grounding > 0


@pytest.mark.parametrize(
    ("trains", "name", "reads"),
    [
        ("both", "tiny", {"ponder", "pounce"}),
        ("pounce", "tiny", {"ponder", "pounce"}),
        ("ponder", "tiny", {"ponder"}),
        ("pounce", "tiny_subgoal_text", {"pounce"}),
    ],
)
def test_a_run_decodes_only_the_pictures_that_it_needs(
    folder: Path, trains: joint.Trains, name: str, reads: set[str]
) -> None:
    episode = trainer_of(recipe_for(trains, name=name), folder)._batches._data[0]
    assert {"ponder" if episode.images[0] else "", "pounce" if episode.views[0] else ""} - {""} == reads


@pytest.mark.parametrize("trains", ["ponder", "pounce"])
def test_the_system_that_learned_is_written_and_no_other(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trains: joint.Trains
) -> None:
    monkeypatch.setitem(recipes.RECIPES, "one", lambda: recipe_for(trains))
    train.train(options(folder, tmp_path / "run"))
    assert {each.name for each in (tmp_path / "run").iterdir() if each.name in ("ponder", "pounce")} == {trains}
    with pytest.raises(train.CheckpointError, match="finished run"):
        train.train(options(folder, tmp_path / "run"))


def test_one_after_the_other_makes_a_pair(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for trains in ("ponder", "pounce"):
        monkeypatch.setitem(recipes.RECIPES, "one", lambda trains=trains: recipe_for(trains))
        given = {"ponder": tmp_path / "ponder" / "ponder"} if trains == "pounce" else {}
        train.train(replace(options(folder, tmp_path / trains), **given))
    bundle = load_bundle(tmp_path / "pounce" / "pounce")
    assert not bundle.is_random
    assert not bundle.has_fresh_prefix
