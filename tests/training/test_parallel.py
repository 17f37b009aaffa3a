"""Two processes with half a batch each do what one does with the whole."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from torch.distributed.tensor import DTensor

from dual_system.models.pi05.pounce import freeze
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.context import Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training import parallel
from dual_system.training.joint import NO_QUERY, JointModel, PonderBatch, PounceBatch
from dual_system.training.optim import OptimConfig
from dual_system.training.parallel import World, checksum, gather, joined, require_alike, shard
from dual_system.training.trainer import TrainConfig, Trainer

CONFIG = replace(tiny_ponder(), image_px=(32, 32), num_layers=4)
TRAIN = TrainConfig(seed=1, dropout=0.3, optim=OptimConfig(learning_rate=1e-3, warmup_steps=3, ema_decay=0.9))
STEPS = 2
PATIENCE_S = 120


def joint(dtype: torch.dtype = torch.float32) -> JointModel:
    """``dtype`` is PONDER's, as under ``pp-train --dtype``."""
    config = tiny_pounce(num_carriers=1, cognition_size=CONFIG.hidden_size, horizon=4)
    pounce = random_pounce(replace(config, max_committed_rows=2), seed=2)
    freeze(pounce, "vision")
    return JointModel(Ponder.random(CONFIG, seed=1, dtype=dtype), pounce)


def batch_of(model: JointModel, places: range, step: int) -> tuple[PonderBatch, PounceBatch]:
    """Three unequal episodes: one query or two, texts of another length, one to three invocations."""
    form, config = model.ponder.format, model.pounce.config
    rows, frames, invocations = [], [], []
    for index, place in enumerate(places):
        said = Transition(subgoal=form.vocabulary.encode("pick the cube" + " now" * (5 * place)))
        rows.append(form.row([*form.opening("press"), *form.query(1, said), *form.query(1) * (place % 2)]))
        generator = torch.Generator().manual_seed(100 * step + place)
        shape = (rows[-1].num_images, 32, 32, 3)
        frames.append(torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8))
        invocations += [(index, query, 100 * step + 10 * place + query) for query in (NO_QUERY, 0, 0)[: place + 1]]
    inputs = [config.example_inputs(1, seed=seed) for _, _, seed in invocations]
    episodes = PonderBatch(rows=tuple(rows), frames=tuple(frames))
    return episodes, PounceBatch(
        inputs=replace(
            inputs[0],
            **{
                name: torch.cat([getattr(each, name) for each in inputs])
                for name in ("images", "has_view", "token_ids", "is_token", "age_ns")
            },
            cognition=None,
        ),
        actions_INA=torch.cat([config.example_actions(1, seed=seed) for _, _, seed in invocations]),
        episode_I=torch.tensor([episode for episode, _, _ in invocations]),
        query_I=torch.tensor([query for _, query, _ in invocations]),
    )


def trainer_of(world: World, weights: str = "sharded") -> Trainer:
    model = joint(torch.bfloat16 if weights == "rounded" else torch.float32)
    if weights != "whole":
        shard(model, world)
    else:
        model.reads_together = False
    return Trainer(model, lambda step: batch_of(model, world.share(3), step), TRAIN, world=world)


def weights_of(trainer: Trainer) -> dict[str, Tensor]:
    whole = joint()
    gather(trainer.model, whole)
    return {name: parameter.detach().clone() for name, parameter in whole.named_parameters()}


def run_as_one_of_several(folder: Path, held: str) -> None:
    """What each process of torchrun does."""
    with joined("cpu") as world:
        (folder / held).mkdir(exist_ok=True)
        _run_float32(folder, held, world)
        _run_rounded(folder, world)


def _run_float32(folder: Path, held: str, world: World) -> None:
    trainer = trainer_of(world, held)
    reports = [asdict(report) for report in trainer.run(STEPS)]
    trainer.save(folder / held / "two")
    last = weights_of(trainer)
    trainer.take_average()
    average = weights_of(trainer)
    resumed = trainer_of(world, held)
    resumed.resume(folder / "one")
    reports += [asdict(report) for report in resumed.run(STEPS + 1)]
    if world.is_first:
        torch.save({"last": last, "average": average}, folder / held / "weights.pt")
        (folder / held / "reports.json").write_text(json.dumps(reports))


def _run_rounded(folder: Path, world: World) -> None:
    """The same for a PONDER in bfloat16 beside a POUNCE in float32."""
    trainer = trainer_of(world, "rounded")
    reports = [asdict(report) for report in trainer.run(STEPS)]
    trainer.save(folder / "rounded")
    resumed = trainer_of(world, "rounded")
    resumed.resume(folder / "rounded")
    kinds: dict[str, int] = {}
    for weight in trainer.model.parameters():
        kind = f"{weight.dtype} {type(weight).__name__ if isinstance(weight, DTensor) else 'whole'}"
        kinds[kind] = kinds.get(kind, 0) + weight.numel()
    on, again = ([asdict(report) for report in each.run(STEPS + 1)] for each in (trainer, resumed))
    if world.is_first:
        (folder / "rounded.json").write_text(json.dumps([reports, on, again, kinds]))


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, float]], Path]:
    """What one process did, and where its checkpoint is."""
    folder = tmp_path_factory.mktemp("parallel")
    trainer = trainer_of(World())
    reports = [asdict(report) for report in trainer.run(STEPS)]
    trainer.save(folder / "one")
    return reports, folder


@pytest.fixture(scope="module", params=["sharded", pytest.param("whole", marks=pytest.mark.acceptance)])
def two(request: pytest.FixtureRequest, one: tuple[list[dict[str, float]], Path]) -> tuple[str, Path]:
    """How two processes of this file held the weights, and where they left what they did."""
    held, (_, folder) = request.param, one
    done = subprocess.run(
        [sys.executable, __file__, str(folder), held],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return held, folder


@pytest.mark.e2e
@pytest.mark.slow
def test_two_processes_are_one(one: tuple[list[dict[str, float]], Path], two: tuple[str, Path]) -> None:
    (reports, folder), (held, _) = one, two
    trainer = trainer_of(World())
    assert trainer.resume(folder / "one")
    theirs = json.loads((folder / held / "reports.json").read_text())
    weights = torch.load(folder / held / "weights.pt", weights_only=True)

    assert len(theirs) == STEPS + 1
    for mine, other in zip(reports, theirs[:STEPS], strict=True):
        assert other == pytest.approx(mine, abs=1e-5, rel=1e-5)
    last = weights_of(trainer)
    for name, tensor in last.items():
        # Adam divides by gradients that are all but nothing: a weight may differ by more than its loss.
        torch.testing.assert_close(weights["last"][name], tensor, atol=3e-5, rtol=0, msg=lambda m, n=name: f"{n}: {m}")

    # A checkpoint of two is read by one, bit for bit, and one of one by two: the next step is the same.
    again = trainer_of(World())
    assert again.resume(folder / held / "two")
    assert again.step == STEPS
    for name, tensor in weights_of(again).items():
        assert torch.equal(weights["last"][name], tensor), name
    again.take_average()
    for name, tensor in weights_of(again).items():
        assert torch.equal(weights["average"][name], tensor), name
    (next_one,) = [asdict(report) for report in trainer.run(STEPS + 1)]
    assert theirs[STEPS] == pytest.approx(next_one, abs=1e-5, rel=1e-5)


@pytest.mark.e2e
@pytest.mark.slow
def test_weights_of_two_dtypes_are_sharded_too(two: tuple[str, Path]) -> None:
    """Two processes round at other places than one: as near as bfloat16 lets them; resumed they are the same."""
    alone = trainer_of(World(), "rounded")
    reports = [asdict(report) for report in alone.run(STEPS)]
    _, folder = two
    theirs, on, again, kinds = json.loads((folder / "rounded.json").read_text())
    for mine, other in zip(reports, theirs, strict=True):
        assert other == pytest.approx(mine, rel=0.02, abs=0.02)
    assert on == again
    assert kinds["torch.bfloat16 DTensor"] > kinds["torch.float32 whole"] > 0
    assert kinds["torch.float32 DTensor"] > 0
    assert "torch.bfloat16 whole" not in kinds
    resumed = trainer_of(World(), "rounded")
    assert resumed.resume(folder / "rounded")
    (next_one,) = [asdict(report) for report in resumed.run(STEPS + 1)]
    assert next_one == pytest.approx(on[0], rel=0.02, abs=0.02)


def test_shares_are_the_batch() -> None:
    shares = [list(World(rank=rank, size=3).share(8)) for rank in range(3)]
    assert sorted(place for share in shares for place in share) == list(range(8))


def test_more_processes_than_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match="a batch of 2 episodes for 3 processes; start at most 2"):
        World(rank=2, size=3).share(2)


def test_a_weight_that_differs_in_one_bit_is_told() -> None:
    model = joint()
    before = checksum(model)
    assert 0 <= before < 1 << 20
    assert checksum(joint()) == before
    weight = next(model.parameters())
    with torch.no_grad():
        bits = weight.view(torch.int32)
        bits.view(-1)[0] ^= 1
    assert checksum(model) != before


@given(sums=st.lists(st.integers(0, (1 << 20) - 1), min_size=1, max_size=256), is_alike=st.booleans(), data=st.data())
def test_processes_are_alike_only_if_all_are(sums: list[int], is_alike: bool, data: st.DataObject) -> None:
    sums = [sums[0]] * len(sums) if is_alike else sums

    class Pretended(World):
        def sums(self, numbers: Sequence[float | Tensor]) -> list[float]:
            assert [float(number) for number in numbers] == [float(sums[0]), float(sums[0] ** 2)]
            return [float(sum(sums)), float(sum(each * each for each in sums))]

    model: Any = None
    with patch.object(parallel, "checksum", lambda _: sums[0]):
        world = Pretended(rank=0, size=len(sums))
        if len(set(sums)) == 1:
            require_alike(model, world)
        else:
            with pytest.raises(ValueError, match="other weights than the rest"):
                require_alike(model, world)


def test_alone_nothing_is_sharded() -> None:
    model = joint()
    before = [type(module) for module in model.modules()]
    shard(model, World())
    assert [type(module) for module in model.modules()] == before


if __name__ == "__main__":  # torchrun's launcher, but what it starts are forks: one import instead of three
    where, way = sys.argv[1:]
    launch = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        start_method="fork",
        rdzv_backend="c10d",
        rdzv_endpoint="127.0.0.1:0",
        local_addr="127.0.0.1",
        max_restarts=0,
    )
    elastic_launch(launch, run_as_one_of_several)(Path(where), way)
