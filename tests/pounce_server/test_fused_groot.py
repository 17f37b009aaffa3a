"""GR00T on the fast path acts as the eager model does: either slot, any batch, padded to buckets, and as an engine."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dual_system.models.golden import read_golden
from dual_system.models.graphs import directly
from dual_system.models.groot.blocks import BlockConfig
from dual_system.models.groot.pounce import GrootInputs, GrootPounce, GrootPounceConfig
from dual_system.models.groot.qwen3 import Qwen3Config
from dual_system.models.kernels.launch import missing_for
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_groot
from dual_system.models.pounce.precision import cast_streams
from dual_system.models.siglip import VisionConfig
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine
from pounce_server.fused import BUCKET_TOKENS, FusedPounce
from pounce_server.operations import KERNELS, TWINS

MAE = {"float32": 1e-5, "bfloat16": 4e-3}
"""Stated tolerance: mean absolute error of the normalised actions after the last step."""
LACK = missing_for(torch.device("cpu"))
NUM_BUCKETS = 4
"""Of prompts of 1 to 200 tokens after two views and three tokens of cognition: 192, 256, 320 and 384 features."""
GOLDEN = Path(__file__).parents[3] / "shared" / "goldens" / "groot_base"

CONFIGS: dict[str, Callable[[], GrootPounceConfig]] = {
    "features": lambda: tiny_groot(num_carriers=2),
    "embeddings": lambda: replace(tiny_groot(num_carriers=2), slot="embeddings"),
    "no prefix": lambda: tiny_groot(num_carriers=0),
}


def model_of(config: GrootPounceConfig, dtype: DTypeName = "float32", seed: int = 0) -> GrootPounce:
    model = random_bundle(config, seed).model
    assert isinstance(model, GrootPounce)
    return cast_streams(model, dtype).eval().requires_grad_(False)  # type: ignore[return-value]


def noise_for(config: GrootPounceConfig, batch_size: int = 1, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch_size, config.horizon, config.padded_action_dim, generator=generator)


@torch.inference_mode()
def eager_actions(model: GrootPounce, inputs: GrootInputs, noise: Tensor) -> Tensor:
    *_, last = model.sample(inputs, noise, model.step_table())
    return last.actions


@torch.inference_mode()
def fused_actions(fused: FusedPounce, inputs: GrootInputs, noise: Tensor) -> Tensor:
    *_, last = fused.sample(inputs, noise)
    return last.actions


def mean_error(actual: Tensor, expected: Tensor) -> float:
    return (actual - expected).abs().mean().item()


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("config", [make() for make in CONFIGS.values()], ids=CONFIGS.keys())
def test_fused_actions_are_the_eager_ones(config: GrootPounceConfig, dtype: DTypeName) -> None:
    model = model_of(config, dtype)
    inputs, noise = config.example_inputs(2, num_tokens=13, seed=1), noise_for(config, 2)
    if inputs.cognition is not None:
        inputs = replace(inputs, is_null=torch.tensor([False, True]))
    expected = eager_actions(model, inputs, noise)
    assert mean_error(fused_actions(FusedPounce(model, TWINS), inputs, noise), expected) <= MAE[dtype]


def test_every_step_is_the_eager_step_and_no_weight_changes() -> None:
    config = tiny_groot(num_carriers=2)
    model = model_of(config)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    inputs, noise = config.example_inputs(1), noise_for(config)
    with torch.inference_mode():
        expected = list(model.sample(inputs, noise, model.step_table()))
        for step in FusedPounce(model, TWINS).sample(inputs, noise):
            torch.testing.assert_close(step.velocity, expected[step.index].velocity, rtol=0, atol=2e-5)
            torch.testing.assert_close(step.actions, expected[step.index].actions, rtol=0, atol=1e-5)
    assert step.index == len(expected) - 1
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    attention = model.groot.dit.blocks[0].attn1
    storages = {p.weight.data.untyped_storage().data_ptr() for p in (attention.to_k, attention.to_v)}
    assert len(storages) == 1, "packed, and not stored twice"


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="the golden groot_base is not in ../shared/goldens beside the checkout")
def test_it_gives_the_public_implementation_s_actions() -> None:
    golden = read_golden(GOLDEN)
    model, given = golden.model, golden.given
    assert isinstance(model, GrootPounce)
    whole = [row for row in golden.end_to_end_rows if given["token_mask"][row].all()]
    assert whole, "padding at the front does not occur in serving"
    for row in whole:
        one = slice(row, row + 1)
        model.config = replace(model.config, embodiment=int(given["embodiment_id"][row]))
        inputs = GrootInputs(
            images=given["images"][one],
            token_ids=given["token_ids"][one],
            is_token=given["token_mask"][one],
            state=given["state"][one, 0],
            embodiment=given["embodiment_id"][one],
            age_ns=torch.zeros(1, dtype=torch.int64),
        )
        actions = fused_actions(FusedPounce(model, TWINS), inputs, given["noise"][one])
        torch.testing.assert_close(actions, golden.expected["actions"][one], rtol=0, atol=1e-4)


def small() -> GrootPounceConfig:
    """Few programs: the interpreter takes a millisecond or two for each. Widths that fill no block."""
    base = tiny_groot(num_carriers=1, horizon=5)
    language = Qwen3Config(width=20, depth=2, mlp_width=28, num_heads=4, num_kv_heads=2, head_dim=6, vocab_size=512)
    vision = VisionConfig(width=12, depth=1, num_heads=3, mlp_width=12, patch_px=112)
    groot = replace(
        base.groot,
        eagle=replace(base.groot.eagle, vision=vision, language=language),
        mixer=BlockConfig(depth=1, num_heads=4, head_dim=5, mlp_width=20),
        dit=BlockConfig(depth=2, num_heads=3, head_dim=4, mlp_width=20),
        hidden_width=10,
        action_dim=9,
    )
    return replace(base, groot=groot, num_steps=2)


@pytest.mark.skipif(bool(LACK), reason=LACK)
@pytest.mark.usefixtures("rounding_interpreter")
@pytest.mark.parametrize("dtype", ["float32", pytest.param("bfloat16", marks=pytest.mark.acceptance)])
def test_kernels_in_the_interpreter_act_as_the_eager_model(dtype: DTypeName, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pounce_server.fused.BUCKET_TOKENS", 8)
    config = replace(small(), max_prompt_tokens=8)
    model = model_of(config, dtype)
    inputs, noise = config.example_inputs(2, num_tokens=5), noise_for(config, 2)
    expected = eager_actions(model, inputs, noise)
    rounding = mean_error(expected, eager_actions(model_of(config), inputs, noise))  # narrow layers round coarsely
    actions = fused_actions(FusedPounce(model, KERNELS), inputs, noise)
    assert mean_error(actions, expected) <= max(MAE["float32"], rounding)


@pytest.mark.parametrize("slot", ["features", "embeddings"])
def test_no_prompt_waits_for_a_capture_and_padding_is_not_seen(slot: str, recorder: Any) -> None:
    """Neither the padding of a bucket nor what an earlier prompt left in it moves an action."""
    config = replace(tiny_groot(num_carriers=2), slot=slot)  # type: ignore[arg-type]
    model, noise = model_of(config), noise_for(config)
    requests = [
        config.example_inputs(1, num_tokens=count, seed=count)
        for count in (4, config.max_prompt_tokens, 1, 4 + BUCKET_TOKENS, 61, 4)
    ]
    expected = [eager_actions(model, inputs, noise) for inputs in requests]
    fused = FusedPounce(model, TWINS, recorder)
    actions = [fused_actions(fused, inputs, noise) for inputs in requests]
    for mine, theirs in zip(actions, expected, strict=True):
        assert mean_error(mine, theirs) <= MAE["float32"]
    assert torch.equal(actions[0], actions[-1])
    invocation = "r" * (1 + config.num_steps)
    captured = "cr" + "c" * (1 + config.num_steps) * NUM_BUCKETS + invocation
    assert recorder.events == captured + ("r" + invocation) * (len(requests) - 1)
    assert sorted(fused._buckets) == [(1, length) for length in (192, 256, 320, 384)]


def test_padding_does_not_grow_from_one_invocation_to_the_next() -> None:
    config = tiny_groot(num_carriers=2)
    fused, noise = FusedPounce(model_of(config), TWINS), noise_for(config)
    streams = []
    for _ in range(2):
        fused_actions(fused, config.example_inputs(1, num_tokens=3), noise)
        streams.append(fused._buckets[1, 192]._language.x.clone())
    assert torch.equal(*streams)


class Timer:
    """Says that kernels take ``kernel`` and twins ``twin``: they are timed in this order."""

    def __init__(self, kernel: float, twin: float) -> None:
        self.times, self.num_calls = (kernel, twin), 0

    def __call__(self, work: Callable[[], object]) -> float:
        work()
        self.num_calls += 1
        return self.times[(self.num_calls - 1) % 2]


@pytest.mark.skipif(bool(LACK), reason=LACK)
@pytest.mark.usefixtures("rounding_interpreter")
@torch.inference_mode()
def test_the_kernels_themselves_are_right_by_the_server_s_own_measure() -> None:
    config = small()
    model = model_of(config)
    network = FusedPounce(model, KERNELS)._network
    inputs = config.example_inputs(1, num_tokens=3)
    prefix = network.embed(inputs, network.see(inputs.images))
    tried = network.bucket(prefix, prefix.num_tokens).try_kernels(Timer(1.0, 2.0))
    assert all(verdict.is_taken for verdicts in tried.values() for verdict in verdicts), tried
    assert [one.operation for one in tried["language"]] == ["norm", "head_rope", "swiglu", "swiglu_product"]


def test_a_kernel_that_is_wrong_or_slow_is_not_taken_and_the_server_says_so() -> None:
    def wrong(gate_up: Tensor, out: Tensor) -> None:
        TWINS.swiglu(gate_up, out)
        out *= 1.01

    def own(x: Tensor, velocity: Tensor, bias: Tensor, num_steps: int) -> None:
        TWINS.euler(x, velocity, bias, num_steps)

    config = tiny_groot(num_carriers=2)
    model, inputs, noise = model_of(config), config.example_inputs(1), noise_for(config)
    expected = eager_actions(model, inputs, noise)
    operations = replace(TWINS, swiglu=wrong, euler=own)
    fused = FusedPounce(model, operations, directly, Timer(1.0, 2.0))
    assert mean_error(fused_actions(fused, inputs, noise), expected) <= MAE["float32"]
    assert fused._network.dit.do == replace(TWINS, euler=own)
    assert fused._network.language.do == TWINS
    assert fused.kernels.startswith("kernels: norm 3/3, head_rope 1/1, swiglu 0/1 (language: it differs from its twin")
    slow = FusedPounce(model, operations, directly, Timer(2.0, 1.0))
    fused_actions(slow, inputs, noise)
    assert slow._network.dit.do == slow._network.mixer.do == TWINS


def test_an_engine_gives_the_eager_engine_s_rows_to_robots_with_other_prompts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of them share a batch; the third, and its bucket, come after it."""
    monkeypatch.setattr("pounce_server.engine.fused_for", lambda model, device, autotune: FusedPounce(model, TWINS))
    eager, fused = (
        EagerEngine(random_bundle(tiny_groot(), 0), path=path)
        for path in ("eager", "fused")  # type: ignore[arg-type]
    )
    request = example_request(eager.spec)
    requests = [
        replace(request, seed=seed, instruction=text) for seed, text in enumerate(("lift the cube", "go", "see"))
    ]
    requests.append(replace(request, seed=9, instruction="lift the cubes"))
    assert fused.spec == eager.spec
    for mine, theirs in zip(fused.invoke_many(requests), eager.invoke_many(requests), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-5)
