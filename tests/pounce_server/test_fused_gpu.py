"""The fast path on a GPU: compiled kernels and CUDA graphs act as the eager model does there."""

from dataclasses import replace

import numpy as np
import pytest

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounceConfig, Family
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine

MAX_MEAN_ERROR = {"float32": 1e-4, "bfloat16": 4e-3}  # TF32 stays off by default, but products are split otherwise


def on_gpu(family: Family) -> AnyPounceConfig:
    """The tiny model with the public head size, which decides which of a GPU's attention kernels runs."""
    if family == "groot":
        groot = tiny_groot().groot
        eagle = replace(groot.eagle, language=replace(groot.eagle.language, head_dim=128))
        return replace(tiny_groot(), groot=replace(groot, eagle=eagle, dit=replace(groot.dit, head_dim=48)))
    tiny = tiny_cpu()
    language, expert = (replace(stream, head_dim=256) for stream in (tiny.pi05.language, tiny.pi05.expert))
    return replace(tiny, pi05=replace(tiny.pi05, language=language, expert=expert))


@pytest.mark.gpu
@pytest.mark.parametrize("family", ["pi05", "groot"])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_replayed_graph_gives_the_eager_engine_s_rows(dtype: DTypeName, family: Family) -> None:
    eager, fused = (
        EagerEngine(random_bundle(on_gpu(family), 0), device="cuda", dtype=dtype, path=path)
        for path in ("eager", "fused")  # type: ignore[arg-type]
    )
    for seed in range(3):  # the first captures, the others replay over new inputs
        request = example_request(eager.spec, seed=seed)
        error = abs(fused.invoke(request) - eager.invoke(request)).mean()
        assert error <= MAX_MEAN_ERROR[dtype]


@pytest.mark.parametrize("family", ["pi05", "groot"])
def test_the_model_of_these_tests_acts_on_a_cpu_too(family: Family) -> None:
    """What runs on a GPU alone would otherwise be found broken there."""
    engine = EagerEngine(random_bundle(on_gpu(family), 0))
    assert np.isfinite(engine.invoke(example_request(engine.spec))).all()
