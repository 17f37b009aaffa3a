"""Gated DeltaNet's rules: transformers' own results, states and gradients, whatever the shape."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from transformers.models.qwen3_5 import modeling_qwen3_5
from transformers.models.qwen3_5.modeling_qwen3_5 import (
    torch_chunk_gated_delta_rule,
    torch_recurrent_gated_delta_rule,
)

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.delta_rule import gated_delta_keeping, gated_delta_rule, gated_delta_step
from dual_system.models.ponder.network import Ponder


def inputs(seed: int, length: int, heads: tuple[int, int], dims: tuple[int, int]) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    key_heads, value_heads = heads

    def noise(*shape: int) -> Tensor:
        return torch.randn(2, *shape, generator=generator)

    return {
        "query": noise(length, key_heads, dims[0]),
        "key": noise(length, key_heads, dims[0]),
        "value": noise(length, value_heads, dims[1]),
        "g": -0.3 * noise(length, value_heads).abs(),
        "beta": noise(length, value_heads).sigmoid(),
        "initial_state": noise(value_heads, *dims),
    }


def error(ours: Tensor, twin: Tensor) -> float:
    """Largest deviation over the largest value."""
    return float((ours.double() - twin.double()).abs().max() / twin.abs().max().clamp(min=1e-2))


def theirs(rule, x: dict[str, Tensor]) -> tuple[Tensor, Tensor]:  # type: ignore[no-untyped-def]
    """A rule of transformers over repeated key heads: not every version repeats them itself."""
    group = x["value"].shape[2] // x["key"].shape[2]
    repeated = {name: x[name].repeat_interleave(group, dim=2) for name in ("query", "key")}
    return rule(**(x | repeated), output_final_state=True, use_qk_l2norm_in_kernel=True)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 999),
    length=st.integers(1, 300),
    heads=st.sampled_from([(1, 1), (1, 3), (2, 2), (2, 4)]),
    dims=st.sampled_from([(8, 8), (16, 32), (32, 16)]),
    chunk=st.sampled_from([16, 32, 64]),
    has_state=st.booleans(),
)
def test_results_and_gradients_are_the_twins(
    seed: int, length: int, heads: tuple[int, int], dims: tuple[int, int], chunk: int, has_state: bool
) -> None:
    x = {name: value.requires_grad_() for name, value in inputs(seed, length, heads, dims).items()}
    if not has_state:
        del x["initial_state"]
    leaves = list(x.values())
    twin = theirs(torch_chunk_gated_delta_rule, x)
    ours = gated_delta_rule(**x, chunk_size=chunk)
    for our, their in zip(ours, twin, strict=True):
        assert error(our.detach(), their.detach()) < 1e-5
    pull = [torch.randn(part.shape, generator=torch.Generator().manual_seed(seed)) for part in twin]
    wanted = torch.autograd.grad(twin, leaves, pull)
    for our, their in zip(torch.autograd.grad(ours, leaves, pull), wanted, strict=True):
        assert error(our, their) < 1e-4


@given(length=st.integers(1, 100), pads=st.integers(1, 70))
@settings(max_examples=20, deadline=None)
def test_padding_without_beta_and_decay_is_inert(length: int, pads: int) -> None:
    x = inputs(length, length + pads, (2, 4), (16, 16))
    x["beta"][:, length:], x["g"][:, length:] = 0, 0
    alone = {name: value if name == "initial_state" else value[:, :length] for name, value in x.items()}
    read, state = gated_delta_rule(**alone)
    padded, padded_state = gated_delta_rule(**x)
    torch.testing.assert_close(padded[:, :length], read, rtol=0, atol=1e-5)
    torch.testing.assert_close(padded_state, state, rtol=0, atol=1e-5)


def test_repeated_keys_that_never_fade_stay_exact() -> None:
    x = inputs(0, 200, (1, 1), (16, 16))
    x["key"][:], x["beta"][:], x["g"][:] = x["key"][:, :1].clone(), 1, 0
    for our, their in zip(gated_delta_rule(**x), theirs(torch_recurrent_gated_delta_rule, x), strict=True):
        assert error(our, their) < 1e-5


def test_bfloat16_comes_back_as_it_went_in() -> None:
    x = {name: value.bfloat16() for name, value in inputs(0, 70, (2, 4), (16, 16)).items()}
    ours, twin = gated_delta_rule(**x), theirs(torch_chunk_gated_delta_rule, x)
    assert (ours[0].dtype, ours[1].dtype) == (torch.bfloat16, torch.float32)
    assert error(ours[0], twin[0]) < 1e-2
    assert error(ours[1], twin[1]) < 1e-5


@pytest.mark.parametrize("wanted", [True, False])
def test_autocast_changes_nothing_inside(wanted: bool) -> None:
    x = inputs(0, 70, (2, 4), (16, 16))
    plain = gated_delta_rule(**x)
    with torch.autocast("cpu", torch.bfloat16, enabled=wanted):
        assert all(torch.equal(our, their) for our, their in zip(gated_delta_rule(**x), plain, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("heads", [(1, 1), (2, 2), (2, 4), (16, 32)])
@pytest.mark.parametrize("dims", [(16, 16), (128, 128)])
def test_a_step_has_the_bits_of_the_twin_s(dtype: torch.dtype, heads: tuple[int, int], dims: tuple[int, int]) -> None:
    x = inputs(0, 1, heads, dims)
    x = {name: value if name in ("g", "initial_state") else value.to(dtype) for name, value in x.items()}
    ours, twin = gated_delta_step(**x), theirs(torch_recurrent_gated_delta_rule, x)
    assert ours[0].dtype == dtype
    assert all(map(torch.equal, ours, twin))


def test_many_steps_are_the_rule_over_many() -> None:
    x = inputs(0, 70, (2, 4), (16, 32))
    state = x.pop("initial_state")
    whole, last = gated_delta_rule(**x, initial_state=state)
    for token in range(70):
        read, state = gated_delta_step(**{name: v[:, token : token + 1] for name, v in x.items()}, initial_state=state)
        assert error(read, whole[:, token : token + 1]) < 1e-4
    assert error(state, last) < 1e-4


@given(
    seed=st.integers(0, 99), length=st.integers(1, 140), share=st.floats(0, 1), heads=st.sampled_from([(1, 1), (2, 4)])
)
@settings(max_examples=25, deadline=None)
def test_the_state_after_the_first_tokens_is_theirs_alone(
    seed: int, length: int, share: float, heads: tuple[int, int]
) -> None:
    """To the last bit where they fill as many chunks; each row has its own number."""
    x = inputs(seed, length, heads, (16, 32))
    x["g"] *= 30.0  # what is later must not overflow
    num_kept = torch.tensor([int(share * length), length])
    read, last, kept = gated_delta_keeping(**x, num_kept_B=num_kept)
    assert kept is not None
    plain = (gated_delta_rule if length > 1 else gated_delta_step)(**x)
    assert torch.equal(read, plain[0])
    assert torch.equal(last, plain[1])
    assert torch.equal(kept[1], last[1])
    later = torch.arange(length) >= num_kept[0]
    if length > 1:
        cut = x | {"beta": x["beta"].masked_fill(later[:, None], 0.0), "g": x["g"].masked_fill(later[:, None], 0.0)}
        assert torch.equal(kept[0], gated_delta_rule(**cut)[1][0])
        alone = {name: value if name == "initial_state" else value[:, ~later] for name, value in x.items()}
        if num_kept[0] > 0:
            torch.testing.assert_close(kept[0], gated_delta_rule(**alone)[1][0], rtol=0, atol=1e-5)


def test_a_layer_calls_no_rule_of_transformers(monkeypatch: pytest.MonkeyPatch) -> None:
    """They know grouped heads in some versions alone, and would be fla's kernels where that package is installed."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("a rule of transformers")

    for name in ("torch_chunk_gated_delta_rule", "torch_recurrent_gated_delta_rule", "causal_conv1d_fn"):
        monkeypatch.setattr(modeling_qwen3_5, name, refuse)
    ponder = Ponder.random(replace(tiny_cpu(), num_layers=4), seed=0)
    assert len(ponder.encode_row(ponder.format.row(ponder.format.opening("go")), None))
    with pytest.raises(ValueError, match="whole rows"):
        ponder.qwen.model.language_model.layers[0].linear_attn(torch.zeros(1, 2, ponder.hidden_size), object())
