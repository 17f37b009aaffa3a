"""A run can be cut anywhere and goes on as if it had not been."""

from __future__ import annotations

import errno
import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.context import Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training import trainer
from dual_system.training.joint import JointModel, PonderBatch, PounceBatch
from dual_system.training.optim import OptimConfig, Optimiser, learning_rate
from dual_system.training.shards import write_rows
from dual_system.training.trainer import CheckpointError, SaveError, TrainConfig, Trainer

CONFIG = replace(tiny_ponder(), image_px=(32, 32), num_layers=4)
TRAIN = TrainConfig(seed=1, dropout=0.3, optim=OptimConfig(learning_rate=1e-3, warmup_steps=3, ema_decay=0.9))
FORM = Ponder.random(CONFIG, seed=1).format
POUNCE_CONFIG = tiny_pounce(num_carriers=1, cognition_size=CONFIG.hidden_size, horizon=4)


def joint(seed: int = 1) -> JointModel:
    pounce = random_pounce(POUNCE_CONFIG, seed=seed)
    return JointModel(Ponder.random(CONFIG, seed=seed), pounce)


def batch(step: int) -> tuple[PonderBatch, PounceBatch]:
    """One short episode of noise and three invocations, another one for every step."""
    said = Transition(subgoal=FORM.vocabulary.encode("pick the cube"))
    row = FORM.row([*FORM.opening("press"), *FORM.query(1, said), *FORM.query(1)])
    generator = torch.Generator().manual_seed(step)
    frames = torch.randint(0, 256, (row.num_images, 32, 32, 3), generator=generator, dtype=torch.uint8)
    invocations = PounceBatch(
        inputs=replace(POUNCE_CONFIG.example_inputs(3, seed=step), cognition=None),
        actions_INA=POUNCE_CONFIG.example_actions(3, seed=step),
        episode_I=torch.zeros(3, dtype=torch.int64),
        query_I=torch.tensor([-1, 0, 1]),
    )
    return PonderBatch(rows=(row,), frames=(frames,)), invocations


def weights(trainer: Trainer) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in trainer.model.named_parameters()}


def test_two_steps_and_a_resume_and_two_steps_are_four_steps(tmp_path: Path) -> None:
    whole = Trainer(joint(), batch, TRAIN)
    reports = list(whole.run(4))
    first = Trainer(joint(), batch, TRAIN)
    cut = list(first.run(2))
    first.save(tmp_path / "checkpoint")
    second = Trainer(joint(seed=9), batch, TRAIN)  # other weights: everything must come from the checkpoint
    assert second.resume(tmp_path / "checkpoint")
    cut += second.run(4)
    assert cut == reports
    for name, tensor in weights(whole).items():
        assert torch.equal(tensor, weights(second)[name]), name
    for name, tensor in whole._optimiser.tensors().items():
        assert torch.equal(tensor, second._optimiser.tensors()[name]), name


def test_training_lowers_the_loss() -> None:
    same = Trainer(joint(), lambda step: batch(0), replace(TRAIN, dropout=0.0))
    losses = [report.total for report in same.run(25)]
    assert sum(losses[-5:]) < 0.8 * sum(losses[:5])


def test_without_a_checkpoint_there_is_nothing_to_resume(tmp_path: Path) -> None:
    assert not Trainer(joint(), batch, TRAIN).resume(tmp_path / "none")


def test_a_save_replaces_the_one_before(tmp_path: Path) -> None:
    trainer = Trainer(joint(), batch, TRAIN)
    trainer.save(tmp_path / "checkpoint")
    list(trainer.run(1))
    trainer.save(tmp_path / "checkpoint")
    assert json.loads((tmp_path / "checkpoint" / "facts.json").read_text())["step"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


@pytest.mark.parametrize("killed", ["while writing", "between the renames"])
def test_a_kill_while_saving_loses_nothing(tmp_path: Path, killed: str) -> None:
    trainer = Trainer(joint(), batch, TRAIN)
    list(trainer.run(1))
    trainer.save(tmp_path / "checkpoint")
    if killed == "while writing":
        (tmp_path / "checkpoint.tmp").mkdir()
        (tmp_path / "checkpoint.tmp" / "weights-00000-of-00001.safetensors").write_bytes(b"half")
    else:
        (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.old")
    again = Trainer(joint(), batch, TRAIN)
    assert again.resume(tmp_path / "checkpoint")
    assert again.step == 1


@pytest.mark.parametrize(
    ("config", "data_hash", "w2", "said"),
    [
        (replace(TRAIN, seed=2), "a", 0.1, "made with train.seed 1, this run has 2"),
        (TRAIN, "b", 0.1, "made with data a, this run has b"),
        (TRAIN, "a", 0.0, "made with w2 0.1, this run has 0.0"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(
    tmp_path: Path, config: TrainConfig, data_hash: str, w2: float, said: str
) -> None:
    Trainer(joint(), batch, TRAIN, data_hash="a", recipe={"w2": 0.1}).save(tmp_path / "checkpoint")
    other = Trainer(joint(), batch, config, data_hash=data_hash, recipe={"w2": w2})
    with pytest.raises(CheckpointError, match=said):
        other.resume(tmp_path / "checkpoint")


@pytest.mark.parametrize(("now", "is_fit"), [("short", True), ("long", False)])
def test_what_a_checkpoint_does_not_name_yet_it_was_made_with_by_default(
    tmp_path: Path, now: str, is_fit: bool
) -> None:
    usual = {"pounce": {"memory": "short"}}
    Trainer(joint(), batch, TRAIN, recipe={"pounce": {"width": 1}}).save(tmp_path / "checkpoint")
    later = Trainer(joint(), batch, TRAIN, recipe={"pounce": {"width": 1, "memory": now}}, recipe_defaults=usual)
    if is_fit:
        assert later.resume(tmp_path / "checkpoint")
    else:
        with pytest.raises(CheckpointError, match=r"made with pounce.memory short, this run has long"):
            later.resume(tmp_path / "checkpoint")


def test_a_loss_that_is_not_finite_stops_before_any_weight_moves() -> None:
    def broken(step: int) -> tuple[PonderBatch, PounceBatch]:
        episodes, invocations = batch(step)
        return episodes, replace(invocations, actions_INA=invocations.actions_INA * float("nan"))

    trainer = Trainer(joint(), broken, TRAIN)
    before = weights(trainer)
    with pytest.raises(FloatingPointError, match="step 0: the loss is nan"):
        list(trainer.run(1))
    assert all(torch.equal(tensor, before[name]) for name, tensor in weights(trainer).items())


def test_warm_up_is_linear_then_constant() -> None:
    config = OptimConfig(learning_rate=1.0, warmup_steps=4)
    assert [learning_rate(config, step) for step in range(6)] == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]


def test_frozen_parameters_stay() -> None:
    model = joint()
    model.ponder.requires_grad_(False)
    trainer = Trainer(model, batch, TRAIN)
    before = weights(trainer)
    list(trainer.run(2))
    moved = {name for name, tensor in weights(trainer).items() if not torch.equal(tensor, before[name])}
    assert moved
    assert not [name for name in moved if name.startswith("ponder.")]


def test_nothing_to_train_is_said() -> None:
    with pytest.raises(ValueError, match="every parameter is frozen"):
        Optimiser(joint().requires_grad_(False), OptimConfig())


def test_a_disk_that_is_full_keeps_the_checkpoint_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Trainer(joint(), batch, TRAIN)
    list(step.run(1))
    step.save(tmp_path / "checkpoint")
    list(step.run(2))
    written = iter([None])

    def full_at_the_second_file(*arguments: object) -> None:
        if next(written, "full") == "full":
            raise OSError(errno.ENOSPC, "No space left on device")
        write_rows(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(trainer, "write_rows", full_at_the_second_file)
    with pytest.raises(SaveError, match=r"step 2: .*No space left on device.*GB are free there.*make room"):
        step.save(tmp_path / "checkpoint")
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]
    again = Trainer(joint(), batch, TRAIN)
    assert again.resume(tmp_path / "checkpoint")
    assert again.step == 1


def joined(*steps: int) -> tuple[PonderBatch, PounceBatch]:
    """The episodes of several steps' batches as one batch."""
    parts = [batch(step) for step in steps]
    inputs = [invocations.inputs for _, invocations in parts]
    values = {
        each.name: torch.cat([getattr(one, each.name) for one in inputs])
        for each in fields(inputs[0])
        if getattr(inputs[0], each.name) is not None
    }
    episodes = PonderBatch(
        rows=tuple(row for each, _ in parts for row in each.rows),
        frames=tuple(frames for each, _ in parts for frames in each.frames),
    )
    return episodes, PounceBatch(
        inputs=replace(inputs[0], **values),
        actions_INA=torch.cat([each.actions_INA for _, each in parts]),
        episode_I=torch.arange(len(steps)).repeat_interleave(3),
        query_I=torch.cat([each.query_I for _, each in parts]),
    )


@pytest.mark.parametrize(("divisions", "dtype"), [((4, 3), torch.float32), ((4,), torch.bfloat16)], ids=str)
def test_a_batch_in_parts_makes_the_step_of_the_whole(divisions: tuple[int, ...], dtype: torch.dtype) -> None:
    """4 x 2, and an uneven division, are 1 x 8."""
    found, config = {}, replace(TRAIN, optim=replace(TRAIN.optim, learning_rate=1e-4))
    for parts in (1, *divisions):
        model = joint()
        model.ponder.to(dtype)
        one = Trainer(model, lambda step: joined(*range(step, step + 8)), config, num_parts=parts)
        found[parts] = list(one.run(2)), one._optimiser._masters, one.latest[1]
    (whole, weights_of_whole, said), *others = found.values()
    for parted, weights_of_parts, said_in_parts in others:
        for one, other in zip(whole, parted, strict=True):
            assert (one.num_supervised, one.num_null) == (other.num_supervised, other.num_null)
            for name in ("total", "flow_matching", "grounding", "gradient_norm"):
                close = 1e-5 if dtype.itemsize == 4 else 2e-2
                assert getattr(one, name) == pytest.approx(getattr(other, name), abs=close)
        assert len(said) == len(said_in_parts)
        for name, weight in weights_of_whole.items():
            close = 1e-5 if dtype.itemsize == 4 else 2e-4  # AdamW moves a weight by its rate where rounding is all
            torch.testing.assert_close(weights_of_parts[name], weight, rtol=0, atol=close)


def test_a_part_without_an_invocation_is_told() -> None:
    episodes, invocations = joined(0, 1)
    invocations = replace(invocations, episode_I=torch.zeros(6, dtype=torch.int64))
    with pytest.raises(ValueError, match="episodes 1 to 1 of a batch have no invocation"):
        next(Trainer(joint(), lambda step: (episodes, invocations), TRAIN, num_parts=2).run(1))


def test_a_run_of_another_recipe_is_refused_by_name(tmp_path: Path) -> None:
    Trainer(joint(), batch, TRAIN, recipe={"name": "robomme", "a": 1}).save(tmp_path / "checkpoint")
    other = Trainer(joint(), batch, TRAIN, recipe={"name": "robomme_0p8b", "a": 2})
    with pytest.raises(CheckpointError, match="made with recipe robomme, this run is of recipe robomme_0p8b"):
        other.resume(tmp_path / "checkpoint")
