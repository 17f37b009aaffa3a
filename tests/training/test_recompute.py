"""Layers that are run again on the way back leave less behind, and every number as it was."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.recompute import recompute_layers
from dual_system.training.joint import PonderBatch, encode_rows

CONFIG = replace(tiny_cpu(), image_px=(32, 32), num_layers=8)


def batch(ponder: Ponder) -> PonderBatch:
    form = ponder.format
    said = Transition(subgoal=form.vocabulary.encode("pick the cube"))
    rows = tuple(form.row([*form.opening("press"), *form.query(1, said), *form.query(1) * n]) for n in (6, 9))
    generator = torch.Generator().manual_seed(0)
    frames = [
        torch.randint(0, 256, (row.num_images, 32, 32, 3), generator=generator, dtype=torch.uint8) for row in rows
    ]
    return PonderBatch(rows=rows, frames=tuple(frames))


def step(ponder: Ponder, together: bool) -> tuple[list[Tensor], dict[str, Tensor]]:
    """What comes out, and every gradient of the sum of its squares."""
    hidden = encode_rows(ponder, batch(ponder), together=together)
    torch.stack([each.square().sum() for each in hidden]).sum().backward()  # type: ignore[no-untyped-call]
    gradients = {name: p.grad.clone() for name, p in ponder.named_parameters() if p.grad is not None}
    ponder.zero_grad()
    return [each.detach() for each in hidden], gradients


@contextmanager
def kept_bytes(into: list[int]) -> Iterator[None]:
    """Counts what is kept for the way back."""

    def pack(tensor: Tensor) -> Tensor:
        into.append(tensor.nbytes if not isinstance(tensor, nn.Parameter) else 0)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        yield


@pytest.mark.parametrize("together", [True, False])
def test_every_number_is_as_it_was(together: bool) -> None:
    ponder = Ponder.random(CONFIG, seed=1)
    hidden, gradients = step(ponder, together)
    recompute_layers(ponder)
    again, same = step(ponder, together)
    assert all(torch.equal(*pair) for pair in zip(hidden, again, strict=True))
    assert gradients.keys() == same.keys()
    assert all(torch.equal(gradients[name], same[name]) for name in gradients)


def test_less_is_kept() -> None:
    ponder, counts = Ponder.random(CONFIG, seed=1), []
    for _ in range(2):
        kept: list[int] = []
        with kept_bytes(kept):
            encode_rows(ponder, batch(ponder), together=True)
        counts.append(sum(kept))
        recompute_layers(ponder)
    assert counts[1] < counts[0] / 3


def test_nothing_inside_a_layer_begins_to_drop_out() -> None:
    ponder = Ponder.random(CONFIG, seed=1)
    recompute_layers(ponder)
    layers = set(ponder.qwen.model.language_model.layers)
    assert {module for module in ponder.modules() if module.training} - {ponder} <= layers


def test_serving_is_not_touched() -> None:
    ponder = Ponder.random(CONFIG, seed=1)
    with torch.no_grad():
        before = encode_rows(ponder, batch(ponder))
        recompute_layers(ponder)
        after = encode_rows(ponder, batch(ponder))
    assert all(torch.equal(*pair) for pair in zip(before, after, strict=True))
