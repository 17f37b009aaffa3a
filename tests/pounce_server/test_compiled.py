"""The compiled path answers as the eager one does, for either family."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from pounce_server.contract import example_request
from pounce_server.engine import EagerEngine


def _shallow() -> PounceConfig:
    """One layer of each kind: compiling takes seconds for each."""
    config = tiny_cpu()
    streams = {name: replace(getattr(config.pi05, name), depth=1) for name in ("vision", "language", "expert")}
    return replace(config, pi05=replace(config.pi05, **streams), num_steps=2)


@pytest.fixture(params=["aot_eager", pytest.param("inductor", marks=pytest.mark.acceptance)])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs the graphs that torch traces. Inductor's C++ takes a minute to compile where nothing is cached."""
    compiled = torch.compile

    def traced(function: Any, *, mode: str) -> Any:
        by_inductor = compiled(function, mode=mode)
        return by_inductor if request.param == "inductor" else compiled(function, backend=request.param)

    monkeypatch.setattr("pounce_server.compiled.torch.compile", traced)


@pytest.mark.slow
@pytest.mark.usefixtures("backend")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("config", [_shallow(), pytest.param(tiny_groot(), marks=pytest.mark.acceptance)])
def test_compiled_rows_are_the_eager_ones(config: Any) -> None:
    eager = EagerEngine(random_bundle(config, seed=0))
    compiled = EagerEngine(random_bundle(config, seed=0), path="compile")
    for seed in (1, 2):
        request = example_request(eager.spec, seed=seed)
        np.testing.assert_allclose(compiled.invoke(request), eager.invoke(request), atol=1e-4)


def test_chunks_are_not_continued_on_it() -> None:
    with pytest.raises(ValueError, match="'compile' knows no --continuity"):
        EagerEngine(random_bundle(tiny_cpu(), seed=0), path="compile", continuity="rtc")
