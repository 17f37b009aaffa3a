"""Weights in bfloat16 move as those in float32 do: what rounds them is not what remembers them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from dual_system.training.optim import OptimConfig, Optimiser
from dual_system.training.parallel import World
from dual_system.training.shards import RowReader, write_rows

CONFIG = OptimConfig(learning_rate=1e-5, warmup_steps=0, ema_decay=0.9)
"""A rate at which no update of one step is half of the last bit of a weight near 1."""


def network(dtype: torch.dtype, seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(6, 5), nn.Linear(5, 3)).to(torch.bfloat16).to(dtype)


def push(model: nn.Module, step: int) -> None:
    """Gives every weight a gradient that bfloat16 can hold."""
    generator = torch.Generator().manual_seed(step)
    for parameter in model.parameters():
        noise = torch.rand(parameter.shape, generator=generator).to(torch.bfloat16)
        parameter.grad = noise.to(parameter.dtype)


def weights(model: nn.Module) -> dict[str, Tensor]:
    return {name: parameter.detach().clone() for name, parameter in model.named_parameters()}


def run(model: nn.Module, optimiser: Optimiser, steps: range) -> list[float]:
    norms = []
    for step in steps:
        push(model, step)
        norms.append(optimiser.update(step))
        assert all(parameter.grad is None for parameter in model.parameters())
    return norms


@given(steps=st.integers(1, 40), rate=st.sampled_from([1e-6, 1e-5, 1e-3]), seed=st.integers(0, 100))
@settings(deadline=None, max_examples=8)
def test_rounded_weights_are_the_whole_ones_rounded(steps: int, rate: float, seed: int) -> None:
    config = replace(CONFIG, learning_rate=rate)
    rounded, whole = network(torch.bfloat16, seed), network(torch.float32, seed)
    one, other = Optimiser(rounded, config), Optimiser(whole, config)
    assert run(rounded, one, range(steps)) == run(whole, other, range(steps))
    for name, weight in weights(whole).items():
        assert torch.equal(weights(rounded)[name], weight.to(torch.bfloat16)), name
        assert torch.equal(one.average[name], other.average[name]), name


def test_small_updates_add_up() -> None:
    """Fifty of a fiftieth of the last bit each."""
    model = nn.ParameterDict({"weight": nn.Parameter(torch.ones(4, dtype=torch.bfloat16))})
    last_bit = 2.0**-8  # of what lies below 1
    optimiser = Optimiser(model, replace(CONFIG, learning_rate=last_bit / 50))
    seen = []
    for step in range(100):
        model["weight"].grad = torch.ones(4, dtype=torch.bfloat16)
        optimiser.update(step)
        seen.append(model["weight"][0].item())
    assert seen[0] == 1.0
    assert seen[-1] == pytest.approx(1 - 2 * last_bit, abs=last_bit / 2)


def test_float32_has_no_second_copy() -> None:
    assert not [name for name in Optimiser(network(torch.float32), CONFIG).tensors() if name.startswith("master")]
    masters = [name for name in Optimiser(network(torch.bfloat16), CONFIG).tensors() if name.startswith("master")]
    assert len(masters) == 4


def _store(model: nn.Module, optimiser: Optimiser, folder: Path) -> dict[str, Tensor]:
    folder.mkdir()
    write_rows(optimiser.tensors(), folder, "optimiser", World())
    return weights(model)


def _restored(folder: Path, stored: dict[str, Tensor], dtype: torch.dtype) -> tuple[nn.Module, Optimiser]:
    model = network(dtype, seed=9)
    optimiser = Optimiser(model, CONFIG)
    model.load_state_dict(stored)
    with RowReader(folder, "optimiser", World()) as rows:
        optimiser.load(rows)
    return model, optimiser


def test_a_cut_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    model = network(torch.bfloat16)
    optimiser = Optimiser(model, CONFIG)
    run(model, optimiser, range(20))
    stored = _store(model, optimiser, tmp_path / "cut")
    run(model, optimiser, range(20, 60))
    again, resumed = _restored(tmp_path / "cut", stored, torch.bfloat16)
    run(again, resumed, range(20, 60))
    for name, tensor in optimiser.tensors().items():
        assert torch.equal(resumed.tensors()[name], tensor), name
    for name, tensor in weights(model).items():
        assert torch.equal(weights(again)[name], tensor), name
    optimiser.take_average()
    assert all(p.dtype == torch.bfloat16 for p in model.parameters())


def test_a_checkpoint_without_masters_goes_on_from_its_weights(tmp_path: Path) -> None:
    """One that was written before there were any."""
    model = network(torch.bfloat16)
    optimiser = Optimiser(model, CONFIG)
    run(model, optimiser, range(5))
    tmp_path.joinpath("old").mkdir()
    state = {name: tensor for name, tensor in optimiser.tensors().items() if not name.startswith("master.")}
    write_rows(state, tmp_path / "old", "optimiser", World())
    _, resumed = _restored(tmp_path / "old", weights(model), torch.bfloat16)
    for name, tensor in weights(model).items():
        assert torch.equal(resumed.tensors()[f"master.{name}"], tensor.float()), name


def test_a_checkpoint_of_another_dtype_is_refused(tmp_path: Path) -> None:
    model = network(torch.bfloat16)
    optimiser = Optimiser(model, CONFIG)
    run(model, optimiser, range(2))
    stored = _store(model, optimiser, tmp_path / "cut")
    with pytest.raises(ValueError, match=r"freeze mode or dtype: it has master\."):
        _restored(tmp_path / "cut", stored, torch.float32)


def test_gradients_that_are_not_finite_move_nothing() -> None:
    model = network(torch.bfloat16)
    optimiser = Optimiser(model, CONFIG)
    before = weights(model)
    push(model, 0)
    next(model.parameters()).grad.fill_(float("nan"))  # type: ignore[union-attr]
    with pytest.raises(FloatingPointError, match=r"not finite \(first in 0\.weight"):
        optimiser.update(0)
    for name, tensor in weights(model).items():
        assert torch.equal(before[name], tensor)
