"""The fast path on a GPU: compiled kernels and CUDA graphs act as the eager model does there."""

import pytest

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine

MAX_MEAN_ERROR = {"float32": 1e-4, "bfloat16": 4e-3}  # TF32 stays off by default, but products are split otherwise


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_replayed_graph_gives_the_eager_engine_s_rows(dtype: DTypeName) -> None:
    eager, fused = (
        EagerEngine(random_bundle(tiny_cpu(), 0), device="cuda", dtype=dtype, path=path)
        for path in ("eager", "fused")  # type: ignore[arg-type]
    )
    for seed in range(3):  # the first captures, the others replay over new inputs
        request = example_request(eager.spec, seed=seed)
        error = abs(fused.invoke(request) - eager.invoke(request)).mean()
        assert error <= MAX_MEAN_ERROR[dtype]
