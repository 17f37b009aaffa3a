"""A larger PONDER is the old one, until it learns; and it can. POUNCE reads of it what it read before."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.training.growing import broadened, grown, reading_more, seeing_deeper

IDS = [5, 17, 200, 31, 8, 90, 44]


def ponder(num_layers: int = 4) -> Ponder:
    return Ponder.random(replace(tiny_cpu(), num_layers=num_layers, full_attention_every=2), seed=3)


def hidden(of: Ponder) -> torch.Tensor:
    """Of a row with a picture in it."""
    form = of.format
    ids = [*IDS, *form.demo(1).ids, *IDS]
    frames = torch.randint(0, 256, (1, *form.image_px, 3), generator=torch.Generator().manual_seed(1)).byte()
    positions, _ = form.positions(ids)
    return of(of.embed(ids, frames)[None], torch.from_numpy(positions)[:, None])


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


def test_deeper_eyes_see_the_same_and_can_learn() -> None:
    old = ponder()
    depth = old.qwen.config.vision_config.depth
    new = seeing_deeper(old, 1)
    assert new.qwen.config.vision_config.depth == len(new.qwen.model.visual.blocks) == depth + 1
    torch.testing.assert_close(hidden(new), hidden(old), rtol=0, atol=0)
    hidden(new).square().sum().backward()
    last = new.qwen.model.visual.blocks[depth]
    for way_out in (last.attn.proj.weight, last.mlp.linear_fc2.weight):
        assert way_out.grad.abs().max() > 0
    with pytest.raises(ValueError, match=f"1 to {depth} more"):
        seeing_deeper(old, depth + 1)


@pytest.mark.parametrize("num_new", [0, 5])
def test_there_must_be_layers_to_copy(num_new: int) -> None:
    with pytest.raises(ValueError, match="1 to 4 more"):
        grown(ponder(), num_new)


@pytest.mark.parametrize(("times", "ffn_size"), [(1.5, 288), (2.0, 192), (2.0, 500)])
def test_a_broader_one_thinks_the_same_in_its_first_numbers_and_nothing_in_the_others(
    times: float, ffn_size: int
) -> None:
    old = ponder()
    size = old.hidden_size
    new = broadened(old, round(times * size), ffn_size)
    text = new.qwen.config.text_config
    assert (text.hidden_size, text.intermediate_size) == (new.hidden_size, ffn_size) == (round(times * size), ffn_size)
    assert text.num_attention_heads == times * old.qwen.config.text_config.num_attention_heads
    with torch.no_grad():
        before, after = hidden(old), hidden(new)
        torch.testing.assert_close(after[..., :size], before, rtol=1e-3, atol=1e-3)
        assert not after[..., size:].any()
        torch.testing.assert_close(new.logits(after), old.logits(before), rtol=1e-3, atol=1e-2)
    assert old.hidden_size == size


def test_new_numbers_heads_and_neurons_learn_from_the_first_step_on() -> None:
    """Whatever writes into them, or from them: what only reads has nothing to read yet."""
    old = ponder()
    new = broadened(old, 2 * old.hidden_size, 2 * old.qwen.config.text_config.intermediate_size)
    hidden(new)[..., : old.hidden_size].square().sum().backward()
    writing = [
        (name, parameter.grad)
        for name, parameter in new.qwen.named_parameters()
        if name.endswith(("out_proj.weight", "o_proj.weight", "down_proj.weight"))
    ]
    last = f"layers.{new.qwen.config.text_config.num_hidden_layers - 1}."
    for name, grad in writing:
        rows, columns = (size // 2 for size in grad.shape)
        assert grad[:rows, columns:].abs().max() > 0, name  # new heads and neurons, into old numbers
        if last not in name:
            assert grad[rows:].abs().max() > 0, name  # into new numbers, which later layers read


@pytest.mark.parametrize(
    ("hidden_size", "ffn_size", "message"),
    [(48, 192, "at least the 96 numbers"), (96, 100, "192 neurons"), (120, 192, "do not come out even at 120")],
)
def test_what_is_smaller_or_uneven_is_refused(hidden_size: int, ffn_size: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        broadened(ponder(), hidden_size, ffn_size)


def test_pounce_reads_of_a_larger_cognition_what_it_read() -> None:
    bundle = random_bundle(pounce_configs.tiny_cpu(cognition_size=96), seed=4)
    more = reading_more(bundle, 144)
    assert more.model.config.cognition.cognition_size == 144
    known, other = torch.randn(2, 1, 96), torch.randn(2, 1, 48)
    ages, is_null = torch.tensor([0, 10**9]), torch.tensor([False, True])
    prefixes = [
        each.model.cognition_prefix(cognition, ages, is_null)  # type: ignore[union-attr, operator]
        for each, cognition in ((bundle, known), (more, torch.cat([known, other], dim=-1)))
    ]
    torch.testing.assert_close(*prefixes)
    rest = {name for name in bundle.model.state_dict() if "cognition_prefix" not in name}
    assert all(torch.equal(more.model.state_dict()[name], bundle.model.state_dict()[name]) for name in rest)
    with pytest.raises(ValueError, match="64 would be fewer"):
        reading_more(bundle, 64)
    with pytest.raises(ValueError, match="GR00T"):
        reading_more(random_bundle(pounce_configs.tiny_groot(cognition_size=96), seed=0), 144)
