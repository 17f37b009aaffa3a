"""What a run says it needs is what it then allocates."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from dual_system.training import memory
from dual_system.training.memory import blank, memory_of, require_room, sentence
from dual_system.training.optim import OptimConfig, Optimiser
from dual_system.training.recipes import recipe


def network(dtype: torch.dtype) -> nn.Module:
    model = nn.Sequential(nn.Linear(6, 5), nn.Linear(5, 3), nn.Linear(3, 2))
    model[2].requires_grad_(False)
    return model.to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("decay", [0.0, 0.9])
def test_the_optimiser_has_the_size_that_was_said(dtype: torch.dtype, decay: float) -> None:
    model, config = network(dtype), OptimConfig(ema_decay=decay)
    said = memory_of(model, config)
    optimiser = Optimiser(model, config)
    model(torch.ones(1, 6, dtype=dtype)).sum().backward()
    optimiser.collect()
    gradients = [each.grad.nbytes for each in optimiser._masters.values() if each.grad is not None]
    assert said.gradients == sum(gradients)
    optimiser.update(0)
    held = {name: tensor for name, tensor in optimiser.tensors().items() if not name.startswith("step.")}
    assert said.optimiser == sum(tensor.nbytes for tensor in held.values())
    assert said.weights == sum(each.nbytes for each in model.parameters())
    assert said.gathered == 0
    assert said.total == said.weights + said.gradients + said.optimiser


def test_processes_divide_all_but_what_is_gathered() -> None:
    run = recipe("tiny")
    one, four = (memory_of(blank(run, "bfloat16"), run.train.optim, count) for count in (1, 4))
    for name in ("weights", "gradients", "optimiser"):
        assert getattr(one, name) / 4 == pytest.approx(getattr(four, name), rel=0.01)
    assert 0 < four.gathered < one.weights


def test_frozen_parts_need_no_optimiser() -> None:
    run = recipe("tiny")
    frozen = replace(run, freeze="vlm")
    whole, less = (memory_of(blank(each, "bfloat16"), run.train.optim) for each in (run, frozen))
    assert less.weights == whole.weights
    assert less.optimiser < whole.optimiser


def test_a_gpu_that_is_too_small_is_told_before_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = memory_of(network(torch.float32), OptimConfig())
    require_room(needed, 1, torch.device("cpu"))

    class Small:
        total_memory = needed.total - 1

    monkeypatch.setattr(memory.torch.cuda, "get_device_properties", lambda device: Small)
    with pytest.raises(ValueError, match=r"in each of 1 processes.*This GPU has 0.0 GB: start more processes"):
        require_room(needed, 1, torch.device("cuda"))
    assert "activations come on top" in sentence(needed, 1)
