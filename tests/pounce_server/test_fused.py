"""The fast path acts as the eager one does: twins and kernels, prefixes whole, isolated, padded, partly missing."""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dual_system.models.graphs import directly
from dual_system.models.kernels.launch import missing_for
from dual_system.models.pi05.gemma import GemmaConfig
from dual_system.models.pi05.pounce import Pounce, PounceConfig, PounceInputs
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.precision import cast_streams
from dual_system.models.siglip import VisionConfig
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine
from pounce_server.fused import BUCKET_TOKENS, FusedPounce, fused_for
from pounce_server.fused_pi05 import SLOT_MULTIPLE
from pounce_server.operations import KERNELS, TWINS, Operations
from pounce_server.serve import PounceServer
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link

MAE = {"float32": 1e-5, "bfloat16": 4e-3}
"""Stated tolerance: mean absolute error of the normalised actions after the last step."""
LACK = missing_for(torch.device("cpu"))
NUM_BESIDE_TEXT = 2 * 64 + 2
"""Two views, the age and one carrier of the tiny model stand before the text."""
NUM_BUCKETS = 4
"""Of prompts of 1 to 200 tokens after these: 192, 256, 320 and 384 tokens."""


def model_of(config: PounceConfig, dtype: DTypeName = "float32", seed: int = 0) -> Pounce:
    model = random_bundle(config, seed).model
    assert isinstance(model, Pounce)
    return cast_streams(model, dtype).eval()  # type: ignore[return-value]


def ragged(config: PounceConfig, seed: int = 0) -> PounceInputs:
    """Two samples: one without its second camera, one with a shorter prompt and null cognition."""
    inputs = config.example_inputs(2, num_tokens=13, seed=seed)
    inputs.has_view[0, 1] = False
    inputs.is_token[1, 9:] = False
    return replace(inputs, is_null=None if inputs.cognition is None else torch.tensor([False, True]))


def noise_for(config: PounceConfig, batch_size: int = 2, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch_size, config.horizon, config.padded_action_dim, generator=generator)


@torch.inference_mode()
def eager_actions(model: Pounce, inputs: PounceInputs, noise: Tensor) -> Tensor:
    *_, last = model.sample(inputs, noise, model.step_table())
    return last.actions


@torch.inference_mode()
def fused_actions(fused: FusedPounce, inputs: PounceInputs, noise: Tensor) -> Tensor:
    *_, last = fused.sample(inputs, noise)
    return last.actions.clone()


def mean_error(actual: Tensor, expected: Tensor) -> float:
    return (actual - expected).abs().mean().item()


CONFIGS: dict[str, Callable[[], PounceConfig]] = {
    "prefix": lambda: tiny_cpu(num_carriers=2),
    "no prefix": lambda: tiny_cpu(num_carriers=0),
    "isolated": lambda: replace(
        tiny_cpu(num_carriers=2), cognition=replace(tiny_cpu(num_carriers=2).cognition, attention="isolated")
    ),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("config", [make() for make in CONFIGS.values()], ids=CONFIGS.keys())
def test_fused_actions_are_the_eager_ones(config: PounceConfig, dtype: DTypeName, seed: int) -> None:
    model = model_of(config, dtype, seed)
    inputs, noise = ragged(config, seed), noise_for(config, seed=seed)
    expected = eager_actions(model, inputs, noise)
    assert mean_error(fused_actions(FusedPounce(model, TWINS), inputs, noise), expected) <= MAE[dtype]


def small(num_kv_heads: int) -> PounceConfig:
    """Few programs: the interpreter takes a millisecond or two for each. Grouped keys, which the public sizes lack."""
    heads = {"depth": 2, "num_heads": 4, "num_kv_heads": num_kv_heads, "head_dim": 6}
    base = tiny_cpu(num_carriers=1, horizon=5)
    pi05 = replace(
        base.pi05,
        vision=VisionConfig(width=12, depth=1, num_heads=3, mlp_width=12, patch_px=112),
        language=GemmaConfig(width=20, mlp_width=28, **heads),
        expert=GemmaConfig(width=12, mlp_width=20, **heads),
        action_dim=9,
    )
    return replace(base, pi05=pi05, num_steps=2)


@pytest.fixture
def few_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter prefixes: the interpreter takes its time for every row."""
    monkeypatch.setattr("pounce_server.fused.BUCKET_TOKENS", 8)


@pytest.mark.skipif(bool(LACK), reason=LACK)
@pytest.mark.usefixtures("rounding_interpreter", "few_tokens")
@pytest.mark.parametrize(
    "dtype", [pytest.param("float32", marks=pytest.mark.acceptance), "bfloat16"]
)  # in float32: the engine's below
@pytest.mark.parametrize("num_kv_heads", [pytest.param(1, marks=pytest.mark.acceptance), 2])
def test_kernels_in_the_interpreter_act_as_the_eager_model(num_kv_heads: int, dtype: DTypeName) -> None:
    config = small(num_kv_heads)
    model = model_of(config, dtype)
    inputs, noise = ragged(config), noise_for(config)
    expected = eager_actions(model, inputs, noise)
    assert mean_error(fused_actions(FusedPounce(model, KERNELS), inputs, noise), expected) <= MAE[dtype]


def test_every_step_is_the_eager_step() -> None:
    config = tiny_cpu(num_carriers=1)
    model = model_of(config)
    inputs, noise = ragged(config), noise_for(config)
    fused = FusedPounce(copy.deepcopy(model), TWINS)
    with torch.inference_mode():
        for expected, step in zip(
            model.sample(inputs, noise, model.step_table()), fused.sample(inputs, noise), strict=True
        ):
            assert step.index == expected.index
            torch.testing.assert_close(step.actions, expected.actions, rtol=0, atol=1e-5)
            torch.testing.assert_close(step.velocity, expected.velocity, rtol=0, atol=1e-5)


def test_packing_holds_no_weight_twice_and_changes_none() -> None:
    model = model_of(tiny_cpu())
    before = {name: value.clone() for name, value in model.state_dict().items()}
    FusedPounce(model, TWINS)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    attention = model.pi05.expert.layers[0].self_attn
    storages = {p.weight.data.untyped_storage().data_ptr() for p in (attention.q_proj, attention.k_proj)}
    assert len(storages) == 1


# -- buckets and graphs, without a GPU


@pytest.fixture
def config() -> PounceConfig:
    return tiny_cpu(num_carriers=1)


def with_tokens(config: PounceConfig, num_tokens: int) -> PounceInputs:
    return config.example_inputs(1, num_tokens=num_tokens, seed=num_tokens)


def test_what_is_captured_once_is_replayed_over_new_inputs(config: PounceConfig, recorder: Any) -> None:
    model = model_of(config)
    noise = noise_for(config, 1)
    num_free = -NUM_BESIDE_TEXT % BUCKET_TOKENS
    requests = [with_tokens(config, count) for count in (num_free, 1, num_free)]
    expected = [eager_actions(model, inputs, noise) for inputs in requests]
    fused = FusedPounce(model, TWINS, recorder)
    for inputs, actions in zip(requests, expected, strict=True):
        assert mean_error(fused_actions(fused, inputs, noise), actions) <= MAE["float32"]
    invocation = "r" * 11
    captured = "cr" + "c" * 11 * NUM_BUCKETS + invocation
    assert recorder.events == captured + ("r" + invocation) * 2, "vision, prefill and ten steps, captured once"


def test_no_prompt_waits_for_a_capture(config: PounceConfig, recorder: Any) -> None:
    """The prompt spells the state in digits: its length changes while a robot moves."""
    model = model_of(config)
    noise = noise_for(config, 1)
    requests = [with_tokens(config, count) for count in (4, 1, 4 + BUCKET_TOKENS, config.max_prompt_tokens, 4)]
    expected = [eager_actions(model, inputs, noise) for inputs in requests]
    fused = FusedPounce(model, TWINS, recorder)
    for inputs, actions in zip(requests, expected, strict=True):
        assert mean_error(fused_actions(fused, inputs, noise), actions) <= MAE["float32"]
    invocation = "r" * 11
    captured = "cr" + "c" * 11 * NUM_BUCKETS + invocation
    assert recorder.events == captured + ("r" + invocation) * (len(requests) - 1)


def test_the_keys_of_an_action_fill_whole_slots(config: PounceConfig) -> None:
    fused = FusedPounce(model_of(config), TWINS)
    fused_actions(fused, with_tokens(config, 3), noise_for(config, 1))
    widths = [bucket._action_run.seen.bias.shape[-1] for bucket in fused._buckets.values()]
    assert len(widths) == NUM_BUCKETS
    assert all(width % SLOT_MULTIPLE == 0 for width in widths)


@pytest.mark.parametrize("is_captured", [False, True], ids=["directly", "captured"])
def test_a_sample_leaves_nothing_behind(config: PounceConfig, recorder: Any, *, is_captured: bool) -> None:
    fused = FusedPounce(model_of(config), TWINS, recorder if is_captured else directly)
    inputs, noise = with_tokens(config, 7), noise_for(config, 1)
    first = fused_actions(fused, inputs, noise)
    fused_actions(fused, with_tokens(config, 9), noise_for(config, 1, seed=1))
    assert torch.equal(fused_actions(fused, inputs, noise), first)


def test_operations_are_the_ones_given(config: PounceConfig) -> None:
    def broken(x: Tensor, velocity: Tensor, bias: Tensor, num_steps: int) -> None:
        x.fill_(7.0)

    operations: Operations = replace(TWINS, euler=broken)
    actions = fused_actions(FusedPounce(model_of(config), operations), with_tokens(config, 3), noise_for(config, 1))
    assert (actions == 7.0).all()


def test_without_triton_the_fused_path_says_what_to_install(
    config: PounceConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dual_system.models.kernels.launch.triton", None)
    with pytest.raises(ValueError, match=r"--path fused cannot run here. Triton is not installed: pip install"):
        fused_for(model_of(config), torch.device("cuda"))


# -- which kernels are taken


class Timer:
    """Says that kernels take ``kernel`` and twins ``twin``: they are timed in this order."""

    def __init__(self, kernel: float, twin: float) -> None:
        self.times, self.num_calls = (kernel, twin), 0

    def __call__(self, work: Callable[[], object]) -> float:
        work()
        self.num_calls += 1
        return self.times[(self.num_calls - 1) % 2]


def test_a_kernel_that_is_wrong_broken_or_slow_is_not_taken_and_the_heartbeat_says_so(config: PounceConfig) -> None:
    def wrong(gate_up: Tensor, out: Tensor) -> None:
        TWINS.geglu(gate_up, out)
        out *= 1.01

    def broken(*arguments: object) -> None:
        raise RuntimeError("no kernel image is available")

    def own(x: Tensor, velocity: Tensor, bias: Tensor, num_steps: int) -> None:
        TWINS.euler(x, velocity, bias, num_steps)

    def whole(*arguments: Any) -> Tensor:
        return TWINS.attend(*arguments)

    operations = replace(TWINS, geglu=wrong, rope=broken, euler=own, attend=whole)
    model, inputs, noise = model_of(config), with_tokens(config, 3), noise_for(config, 1)
    expected = eager_actions(model, inputs, noise)
    fused = FusedPounce(model, operations, directly, Timer(1e-3, 2e-3))
    assert fused.kernels == ""
    assert mean_error(fused_actions(fused, inputs, noise), expected) <= MAE["float32"]
    assert fused._network.expert.do == replace(TWINS, euler=own, attend=whole)
    assert fused.kernels.startswith("kernels: norm 2/2, rope 0/2 (prefill: it does not run: RuntimeError: no kernel")
    assert "geglu 0/2 (prefill: it differs from its twin by 1.0e-02" in fused.kernels
    assert fused.kernels.endswith("attend 2/2, geglu_product 2/2, euler 1/1")
    slow = FusedPounce(model, operations, directly, Timer(2e-3, 1e-3))
    fused_actions(slow, inputs, noise)
    assert slow._network.expert.do == slow._network.language.do == TWINS
    assert "norm 0/2 (prefill: 2.0 us, its twin 1.0; it differs by 0.0e+00)" in slow.kernels


@pytest.mark.skipif(bool(LACK), reason=LACK)
@pytest.mark.usefixtures("rounding_interpreter")
@torch.inference_mode()
def test_the_kernels_themselves_are_right_by_the_server_s_own_measure() -> None:
    config = small(2)
    model = model_of(config)
    prefix = model.embed_prefix(with_tokens(config, 3))
    bucket = FusedPounce(model, KERNELS)._network.bucket(prefix, prefix.num_tokens)
    tried = bucket.try_kernels(Timer(1.0, 2.0))
    assert all(verdict.is_taken for verdicts in tried.values() for verdict in verdicts), tried


# -- as an engine


@pytest.mark.skipif(bool(LACK), reason=LACK)
@pytest.mark.usefixtures("rounding_interpreter", "few_tokens")
def test_a_fused_engine_gives_the_eager_engine_s_rows() -> None:
    eager, fused = (
        EagerEngine(random_bundle(small(1), 0), path=path)
        for path in ("eager", "fused")  # type: ignore[arg-type]
    )
    request = example_request(eager.spec)
    assert fused.spec == eager.spec
    np.testing.assert_allclose(fused.invoke(request), eager.invoke(request), rtol=0, atol=1e-5)


@pytest.mark.usefixtures("short_warm_up")
def test_a_heartbeat_says_which_kernels_were_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    def tried(model: Pounce, device: torch.device, *, autotune: bool) -> FusedPounce:
        return FusedPounce(model, TWINS, directly, Timer(1.0, 2.0))

    monkeypatch.setattr("pounce_server.engine.fused_for", tried)
    engine = EagerEngine(random_bundle(small(1), 0), path="fused")
    link = Link(LocalBus(), robot="r0", proc="pounce")
    heartbeat = Heartbeat(link, "test", "host/monotonic")
    PounceServer(link, engine, heartbeat, "test").warm_up()
    assert (
        heartbeat.health.detail
        == engine.spec.kernels
        == ("kernels: norm 2/2, rope 2/2, geglu 2/2, attend 2/2, geglu_product 2/2, euler 1/1")
    )


def test_what_the_fused_path_cannot_do_is_refused() -> None:
    for config in (tiny_cpu(), tiny_groot()):
        with pytest.raises(ValueError, match=r"the path 'fused' knows no --continuity; leave one of them out"):
            EagerEngine(random_bundle(config, 0), path="fused", continuity="rtc")


def test_a_cpu_that_may_not_interpret_is_told_where_kernels_run(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("triton")
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    with pytest.raises(ValueError, match=r"compiles for a GPU, came device cpu: --device cuda .*; or --path eager"):
        EagerEngine(random_bundle(tiny_cpu(), 0), path="fused")
