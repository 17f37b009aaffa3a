"""What is captured by default; captured work itself is tested with its owners, and on a GPU."""

import pytest
import torch

from dual_system.models import graphs


def test_work_is_captured_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "cuda_graphs", lambda: graphs.directly)
    assert graphs.graphs_for(torch.device("cuda", 0)) is graphs.directly
    assert graphs.graphs_for(torch.device("cpu")) is None


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_graphs_that_share_a_pool_leave_each_other_s_results_alone() -> None:
    x, doubled, squared = (torch.zeros(1024, device="cuda") for _ in range(3))
    capture = graphs.cuda_graphs()
    double = capture(lambda: doubled.copy_(x + x.clone()))  # type: ignore[arg-type, return-value]
    square = capture(lambda: squared.copy_(x * x.clone()))  # type: ignore[arg-type, return-value]
    for value in (3.0, 5.0):
        x.fill_(value)
        double()
        square()
        assert (doubled == 2 * value).all()
        assert (squared == value * value).all()
