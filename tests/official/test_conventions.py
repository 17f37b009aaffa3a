"""Conventions of the cognition prefix that nothing public decides: each is one field of POUNCE's config.json."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from dual_system.models.interface import CognitionConfig
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_pounce


def pounce(**changes: Any) -> Pounce:
    config = tiny_cpu()
    model = random_pounce(replace(config, cognition=replace(config.cognition, **changes), state_input="token"), seed=1)
    assert model.cognition_prefix is not None
    if model.cognition_prefix.age_projection.bias is not None:
        torch.nn.init.ones_(model.cognition_prefix.age_projection.bias)
    return model.eval()


def actions(model: Pounce, **changes: Any) -> torch.Tensor:
    inputs = replace(model.config.example_inputs(1), **changes)
    noise = torch.randn(
        1, model.config.horizon, model.config.padded_action_dim, generator=torch.Generator().manual_seed(0)
    )
    with torch.inference_mode():
        return [step.actions for step in model.sample(inputs, noise, model.step_table())][-1]


@pytest.mark.parametrize(
    "changes",
    [{"age_bias": True}, {"order": "cognition_first"}, {"place": "after_text"}, {"age_max_period_s": 10.0}],
)
def test_each_convention_changes_the_actions(changes: dict[str, Any]) -> None:
    assert not torch.allclose(actions(pounce()), actions(pounce(**changes)), atol=1e-4)


def test_the_order_swaps_tokens_and_nothing_else() -> None:
    first, last = pounce().cognition_prefix, pounce(order="cognition_first").cognition_prefix
    assert first is not None
    assert last is not None
    cognition, age = torch.randn(1, 1, 64, generator=torch.Generator().manual_seed(0)), torch.tensor([300_000_000])
    assert torch.equal(first(cognition, age).flip(1), last(cognition, age))


def test_after_the_text_stands_the_prefix_behind_the_state() -> None:
    inputs = tiny_cpu().example_inputs(1)
    state = torch.zeros(1, 8)
    before, after = (
        pounce(place=place).embed_prefix(replace(inputs, state=state)) for place in ("before_images", "after_text")
    )
    assert torch.equal(after.embeds, torch.cat([before.embeds[:, 2:], before.embeds[:, :2]], dim=1))
    assert after.positions().tolist() == [[*range(after.embeds.shape[1])]]


def test_after_padded_text_the_prefix_acts_alike() -> None:
    model = pounce(place="after_text")
    inputs = model.config.example_inputs(1)
    pads = torch.zeros(1, 5, dtype=torch.int64)
    padded = {
        "token_ids": torch.cat([inputs.token_ids, pads], dim=1),
        "is_token": torch.cat([inputs.is_token, pads.bool()], dim=1),
    }
    torch.testing.assert_close(actions(model, **padded), actions(model), atol=1e-5, rtol=0)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="needs attention 'full'"):
        CognitionConfig(place="after_text", attention="isolated")
    config = tiny_groot()
    with pytest.raises(ValueError, match="before the images only"):
        replace(config, cognition=replace(config.cognition, place="after_text"))
