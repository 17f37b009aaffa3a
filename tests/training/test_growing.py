"""A grown PONDER is the old one, until it learns; and it can."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_configs import tiny_cpu
from ponderpounce.training.growing import grown

IDS = [5, 17, 200, 31, 8, 90, 44]


def ponder(num_layers: int = 4) -> Ponder:
    return Ponder.random(replace(tiny_cpu(), num_layers=num_layers, full_attention_every=2), seed=3)


def hidden(of: Ponder) -> torch.Tensor:
    positions, _ = of.format.positions(IDS)
    return of(of.embed(IDS)[None], torch.from_numpy(positions)[:, None])


@pytest.mark.parametrize("num_new", [1, 2, 4])
def test_a_grown_one_thinks_the_same(num_new: int) -> None:
    old = ponder()
    new = grown(old, num_new)
    text = new.qwen.config.text_config
    assert text.num_hidden_layers == len(new.qwen.model.language_model.layers) == 4 + num_new
    assert text.layer_types[4:] == text.layer_types[4 - num_new : 4]
    torch.testing.assert_close(hidden(new), hidden(old), rtol=0, atol=0)
    assert old.qwen.config.text_config.num_hidden_layers == 4


def test_what_is_new_can_learn() -> None:
    new = grown(ponder(), 2)
    hidden(new).square().sum().backward()
    ways_out = [
        parameter.grad
        for name, parameter in new.qwen.named_parameters()
        if ("layers.4." in name or "layers.5." in name) and name.endswith(("out_proj.weight", "o_proj.weight"))
    ]
    assert len(ways_out) == 2
    assert all(grad is not None and grad.abs().max() > 0 for grad in ways_out)


@pytest.mark.parametrize("num_new", [0, 5])
def test_there_must_be_layers_to_copy(num_new: int) -> None:
    with pytest.raises(ValueError, match="1 to 4 more"):
        grown(ponder(), num_new)
