"""Matrices that Muon turns: only those of hidden layers, in steps of AdamW's length, and no less repeatable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from dual_system.training import optim
from dual_system.training.muon import Muon
from dual_system.training.optim import OptimConfig, Optimiser
from dual_system.training.parallel import World
from dual_system.training.shards import RowReader, write_rows

CONFIG = OptimConfig(learning_rate=1e-3, warmup_steps=0, weight_decay=0.0, matrices="muon", ema_decay=0.9)


class Network(nn.Module):
    def __init__(self, rows: int = 12, columns: int = 16, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.embed_tokens = nn.Embedding(20, columns)
        self.hidden = nn.Linear(columns, rows)
        self.gate = nn.Linear(columns, 4)
        self.lm_head = nn.Linear(rows, 20, bias=False)


def push(model: nn.Module, step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def weights(model: nn.Module) -> dict[str, Tensor]:
    return {name: parameter.detach().clone() for name, parameter in model.named_parameters()}


def moved(config: OptimConfig, model: nn.Module, steps: int = 1) -> dict[str, Tensor]:
    before, optimiser = weights(model), Optimiser(model, config)
    for step in range(steps):
        push(model, step)
        optimiser.update(step)
    return {name: after - before[name] for name, after in weights(model).items()}


def test_all_but_hidden_layers_matrices_move_as_with_adamw() -> None:
    by_muon, by_adamw = (moved(replace(CONFIG, matrices=each), Network()) for each in ("muon", "adamw"))  # type: ignore[arg-type]
    differs = {name for name in by_muon if not torch.equal(by_muon[name], by_adamw[name])}
    assert differs == {"hidden.weight"}


@given(rows=st.integers(8, 24), columns=st.integers(8, 24), seed=st.integers(0, 50))
@settings(deadline=None, max_examples=25)
def test_a_step_goes_as_far_in_every_direction(rows: int, columns: int, seed: int) -> None:
    step = moved(CONFIG, Network(rows, columns, seed))["hidden.weight"]
    stretches = torch.linalg.svdvals(step) / (0.2 * CONFIG.learning_rate * max(rows, columns) ** 0.5)
    assert stretches.max() < 1.3  # the five iterations bring singular values near 1, not to it
    assert stretches.median() > 0.5


def test_a_cut_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole, cut = Network(), Network()
    one, other = Optimiser(whole, CONFIG), Optimiser(cut, CONFIG)
    for step in range(4):
        push(whole, step)
        one.update(step)
    for step in range(2):
        push(cut, step)
        other.update(step)
    write_rows(other.tensors(), tmp_path, "optimiser", World())
    again = Network(seed=3)
    again.load_state_dict(cut.state_dict())
    resumed = Optimiser(again, CONFIG)
    with RowReader(tmp_path, "optimiser", World()) as stored:
        resumed.load(stored)
    for step in range(2, 4):
        push(again, step)
        resumed.update(step)
    assert all(torch.equal(tensor, weights(again)[name]) for name, tensor in weights(whole).items())
    assert all(torch.equal(tensor, resumed.tensors()[name]) for name, tensor in one.tensors().items())


def test_a_checkpoint_of_adamw_is_refused(tmp_path: Path) -> None:
    before = Optimiser(Network(), replace(CONFIG, matrices="adamw"))
    model = Network()
    push(model, 0)
    stored = Optimiser(model, replace(CONFIG, matrices="adamw"))
    stored.update(0)
    write_rows(stored.tensors(), tmp_path, "optimiser", World())
    with RowReader(tmp_path, "optimiser", World()) as rows:
        before.load(rows)
        with pytest.raises(ValueError, match="another model, freeze mode, dtype or optimiser"):
            Optimiser(Network(), CONFIG).load(rows)


def test_matrices_of_which_a_process_has_some_rows_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optim, "DTensor", nn.Parameter)  # as if every one was sharded
    with pytest.raises(ValueError, match="--weights whole"):
        Optimiser(Network(), CONFIG)


def test_it_is_torchs_own_but_for_what_bfloat16_rounds() -> None:
    shapes = [(24, 16), (16, 24), (24, 16), (8, 8)]
    generator = torch.Generator().manual_seed(3)
    ours, theirs = ([nn.Parameter(torch.ones(shape)) for shape in shapes] for _ in range(2))
    mine = Muon(ours, lr=1e-2, weight_decay=0.1)
    peer = torch.optim.Muon(theirs, lr=1e-2, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for step in range(3):
        for one, other in zip(ours, theirs, strict=True):
            one.grad = torch.randn(one.shape, generator=generator)
            other.grad = one.grad.clone()
        if step == 1:
            ours[3].grad = theirs[3].grad = None
        mine.step()
        peer.step()
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(mine.state[one]["momentum_buffer"], peer.state[other]["momentum_buffer"])
        assert (one - other).norm() < 0.02 * (1 - other).norm()


def test_a_vector_is_refused() -> None:
    with pytest.raises(ValueError, match=r"matrices, came a parameter of shape \(3,\)"):
        Muon([nn.Parameter(torch.zeros(3))])
