"""PONDER in int8 and fp8: near its exact self, and who serves it says how near."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models import fp8
from dual_system.models.fp8 import Fp8Linear
from dual_system.models.graphs import directly
from dual_system.models.int8 import Int8Linear
from dual_system.models.kernels.fp8 import FEW_ROWS, few_rows_eager, quantise_eager
from dual_system.models.kernels.trial import choose
from dual_system.models.ponder.checkpoint import save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.__main__ import build_engine
from ponder_server.config import ContextOptions, PonderOptions, SpeedOptions
from ponder_server.contract import Opening, WeightsName
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.narrow import check_change, quantise
from ponder_server.operations import TWINS
from ponder_server.rehearsal import rehearse
from ponder_server.serve import PonderServer
from ponder_server.slots import SlotMemory
from ponder_server.stack import Stack
from protocol.heartbeat import Heartbeat

MODEL = replace(tiny_cpu(), num_layers=4, hidden_size=48, ffn_size=96, image_px=(32, 32), num_carriers=2)
CONFIG = EngineConfig(num_cameras=1, max_context_tokens=200, max_sessions=2)


narrow = pytest.mark.parametrize("weights", ["int8", "fp8"])


def engine_of(weights: WeightsName, dtype: torch.dtype = torch.float32) -> QwenEngine:
    return QwenEngine(Ponder.random(MODEL, seed=1, dtype=dtype), replace(CONFIG, weights=weights))


@narrow
def test_the_layers_take_a_quarter_and_the_rest_is_untouched(weights: WeightsName) -> None:
    ponder = Ponder.random(MODEL, seed=0)
    before = {name: parameter.clone() for name, parameter in ponder.qwen.named_parameters()}
    saved = quantise(ponder, weights)
    after = dict(ponder.qwen.named_parameters())
    gone = {name for name in before if name not in after}
    assert saved == 3 * sum(before[name].numel() for name in gone)
    assert all(torch.equal(after[name], before[name]) for name in after)
    kept_matrices = {name.split("layers.")[-1] for name in after if after[name].ndim == 2}
    assert {name.partition(".")[2] for name in kept_matrices if name[0].isdigit()} == {
        "linear_attn.in_proj_a.weight", "linear_attn.in_proj_b.weight",
    }  # fmt: skip
    assert {"lm_head.weight", "model.language_model.embed_tokens.weight", "model.visual.pos_embed.weight"} <= set(after)
    assert {f"model.language_model.layers.{index}.mlp.down_proj.weight" for index in range(4)} < gone
    assert any(name.startswith("model.visual.blocks.1.") for name in gone) is (weights == "int8"), "fp8: text alone"


@narrow
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_change_of_cognition_that_is_told_is_the_one_that_is_seen(weights: WeightsName, dtype: torch.dtype) -> None:
    """As any client sees it: the warm-up's episode, asked once of the exact weights and once of the narrow ones."""
    exact, changed = engine_of("float", dtype), engine_of(weights, dtype)
    frame = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    seen = []
    for engine in (exact, changed):
        engine.open("a", Opening(instruction="warm up"))
        fire = engine.fire("a", (frame,))
        assert not fire.is_transition
        seen.append(fire.cognition)
    change = np.linalg.norm(seen[1] - seen[0]) / np.linalg.norm(seen[0])
    assert changed.spec.cognition_error == pytest.approx(change, rel=1e-4)
    assert 0 < change < {"int8": 0.1, "fp8": 0.2}[weights]
    assert (changed.spec.weights, changed.spec.model_hash) == (weights, f"{exact.spec.model_hash}-{weights}")


def test_unquantised_is_the_default() -> None:
    engine = build_engine(PonderOptions(context=ContextOptions(max_context_tokens=400)))
    assert isinstance(engine, QwenEngine)
    assert (engine.spec.weights, engine.spec.cognition_error) == ("float", 0)
    assert not any(isinstance(module, Int8Linear | Fp8Linear) for module in engine._ponder.modules())


def test_measuring_it_leaves_no_session_behind() -> None:
    engine = engine_of("int8")
    for name in range(CONFIG.max_sessions):
        engine.open(str(name), Opening(instruction="press"))


@pytest.mark.usefixtures("short_warm_up")
@narrow
def test_the_server_says_it_in_its_health_and_log(
    weights: WeightsName, new_rig: Any, caplog: pytest.LogCaptureFixture
) -> None:
    engine = engine_of(weights)
    heartbeat = Heartbeat(new_rig().links["ponder"], "test", "host/monotonic")
    with caplog.at_level(logging.INFO):
        PonderServer(heartbeat._link, engine, heartbeat, "test").warm_up()
    told = f"{weights} weights: relative L2 change of cognition {engine.spec.cognition_error:.1e} at start"
    assert heartbeat.health.detail == told
    assert told in caplog.text


@narrow
def test_a_checkpoint_is_loaded_as_ever_and_then_made_narrow(weights: WeightsName, tmp_path: Path) -> None:
    save_ponder(Ponder.random(MODEL, seed=1), tmp_path)
    options = PonderOptions(
        checkpoint=tmp_path, speed=SpeedOptions(weights=weights), context=ContextOptions(max_context_tokens=200)
    )
    config = replace(CONFIG, num_cameras=2)
    loaded, made = build_engine(options), QwenEngine(Ponder.random(MODEL, seed=1), replace(config, weights=weights))
    assert isinstance(loaded, QwenEngine)
    assert loaded.spec.model_hash == made.spec.model_hash
    assert loaded.spec.cognition_error == made.spec.cognition_error
    tensors = [dict(engine._ponder.qwen.state_dict()) for engine in (loaded, made)]
    assert tensors[0].keys() == tensors[1].keys()
    assert all(torch.equal(tensor.float(), tensors[1][name].float()) for name, tensor in tensors[0].items())


@pytest.mark.parametrize(
    ("weights", "device", "why"),
    [
        ("int8", "meta", "int8 weights are for a CPU; take --weights fp8, or leave it out"),
        ("fp8", "meta", "fp8 weights are for a CPU or a CUDA GPU, not for 'meta'; take --weights int8 on a CPU"),
    ],
)
def test_what_a_device_cannot_have_is_refused_by_name(weights: WeightsName, device: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        QwenEngine(Ponder.random(MODEL, seed=1, device=device), replace(CONFIG, weights=weights))


def test_a_torch_without_fp8_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch, "float8_e4m3fn")
    with pytest.raises(ValueError, match=r"torch .* has no float8_e4m3fn; take --weights int8 on a CPU"):
        engine_of("fp8")


def test_weights_that_change_a_trained_network_s_cognition_too_much_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ponder_server.narrow.MOST_CHANGE", 1e-3)
    trained = Ponder.random(MODEL, seed=1)
    trained.is_random = False
    with pytest.raises(ValueError, match=r"fp8 weights change cognition by .* at most 1e-03 .* Leave --weights out"):
        QwenEngine(trained, replace(CONFIG, weights="fp8"))
    check_change("fp8", 9.0, is_random=True)
    with pytest.raises(ValueError, match="by nan"):
        check_change("int8", float("nan"), is_random=False)


EVEN = replace(MODEL, hidden_size=64, ffn_size=96)


def test_a_captured_forward_of_fp8_products_is_the_network_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU: torch's ``_scaled_mm`` runs on a CPU too. Rows are quantised by norms and before two products."""
    monkeypatch.setattr(fp8, "has_products", lambda device: True)
    engines = [
        QwenEngine(Ponder.random(EVEN, seed=1, dtype=torch.bfloat16), replace(CONFIG, weights="fp8"), capture=capture)
        for capture in (None, directly)
    ]
    captured = engines[1]._runner._captured
    assert captured is not None
    assert captured._stack.multiplies_fp8
    expected, came = (engine._example_cognition() for engine in engines)
    assert len(captured) == 2, "the opening and the query"
    change = float((came - expected).norm() / expected.norm())
    assert change < engines[0].spec.cognition_error


def test_kernels_of_fp8_are_tried_where_their_rows_are() -> None:
    """Few rows by a product of their own; whatever is not tried stays a twin."""
    ponder = Ponder.random(EVEN, seed=1, dtype=torch.bfloat16)
    quantise(ponder, "fp8")
    for layer in ponder.qwen.modules():
        if isinstance(layer, Fp8Linear):
            layer.multiplies = True
    config = ponder.qwen.config.text_config
    memory = SlotMemory(config, num_slots=1, max_tokens=64, device=ponder.device, dtype=ponder.dtype)
    stack = Stack.of(ponder.qwen.model.language_model)
    wrong, right = (lambda x: quantise_eager(2 * x)), (lambda x, *weight: few_rows_eager(x, *weight))
    kernels = replace(TWINS, quantise=wrong, few_rows=right)
    times = cycle((1.0, 2.0))  # a kernel's, and its twin's
    with torch.inference_mode():
        for length, tried in ((FEW_ROWS, {"quantise": False, "few_rows": True}), (FEW_ROWS + 1, {"quantise": False})):
            samples = rehearse(stack, memory, num_rows=1, length=length)
            _, verdicts = choose(samples, TWINS, kernels, lambda work: next(times))
            taken = {one.operation: one.is_taken for one in verdicts}
            assert {name: taken[name] for name in ("quantise", "few_rows") if name in taken} == tried
