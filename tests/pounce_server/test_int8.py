"""int8 weights: near the exact ones, a quarter of the bytes, and whoever serves them says what they cost."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_pounce
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine
from pounce_server.int8 import quantise
from pounce_server.serve import PounceServer
from protocol.heartbeat import Heartbeat


def test_the_streams_matrices_take_a_quarter_and_the_rest_is_untouched() -> None:
    model = random_pounce(tiny_cpu(), 0)
    before = {name: parameter.clone() for name, parameter in model.named_parameters()}
    saved = quantise(model)
    after = dict(model.named_parameters())
    gone = [name for name in before if name not in after]
    assert gone
    assert all(name.endswith(".weight") and "norm" not in name for name in gone)
    assert saved == 3 * sum(before[name].numel() for name in gone)
    assert all(torch.equal(after[name], before[name]) for name in after)
    assert "pi05.action_out_proj.weight" in after


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("config", [tiny_cpu(), tiny_groot()], ids=["pi05", "groot"])
def test_an_engine_acts_nearly_alike_and_tells_how_nearly(config: Any, dtype: DTypeName) -> None:
    exact, narrow = (
        EagerEngine(random_bundle(config, seed=0), weights=weights, dtype=dtype) for weights in ("float", "int8")
    )
    request = example_request(exact.spec, seed=9)
    error = np.abs(narrow.invoke(request) - exact.invoke(request)).mean()
    assert 0 < error < 0.02
    assert 0 < narrow.spec.action_error < 0.05
    assert exact.spec.action_error == 0
    assert narrow.spec.model_hash == f"{exact.spec.model_hash}-int8"
    np.testing.assert_array_equal(narrow.invoke(request), narrow.invoke(request))


@pytest.mark.usefixtures("short_warm_up")
def test_the_server_says_it_in_its_health_and_log(new_rig: Any, caplog: pytest.LogCaptureFixture) -> None:
    engine = EagerEngine(random_bundle(tiny_cpu(), seed=0), weights="int8")
    link = new_rig().links["pounce"]
    heartbeat = Heartbeat(link, "test", "host/monotonic")
    with caplog.at_level(logging.INFO):
        PounceServer(link, engine, heartbeat, "test").warm_up()
    told = f"int8 weights: mean error of the normalised actions {engine.spec.action_error:.1e}"
    assert heartbeat.health.detail == told
    assert told in caplog.text


def test_int8_is_refused_where_it_is_of_no_use() -> None:
    with pytest.raises(ValueError, match="for the eager path on a CPU"):
        EagerEngine(random_bundle(tiny_cpu(), seed=0), weights="int8", path="fused")
