"""What is captured by default; captured work itself is tested with its owners, and on a GPU."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import MagicMock

import pytest
import torch

from dual_system.models import graphs


def test_work_is_captured_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "cuda_graphs", lambda device: graphs.directly)
    assert graphs.graphs_for(torch.device("cuda", 0)) is graphs.directly
    assert graphs.graphs_for(torch.device("cpu")) is None


def test_all_of_a_capture_happens_on_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two GPUs the current one is the first: streams, pools and graphs would be there."""
    current, seen = [torch.device("cuda", 0)], []

    @contextmanager
    def device(wanted: torch.device) -> Iterator[None]:
        current.append(wanted)
        yield
        current.pop()

    def noting(*args: object, **kwargs: object) -> MagicMock:
        seen.append(current[-1].index)
        return MagicMock()

    monkeypatch.setattr(torch.cuda, "device", device)
    for name in ("graph_pool_handle", "Stream", "current_stream", "stream", "CUDAGraph", "graph"):
        monkeypatch.setattr(torch.cuda, name, noting)
    runs = []
    graphs.cuda_graphs(torch.device("cuda", 1))(lambda: runs.append(current[-1].index))
    assert runs == [1] * (graphs.WARM_UPS + 1)
    assert len(seen) >= 6
    assert set(seen) == {1}


@pytest.mark.gpu
def test_graphs_that_share_a_pool_leave_each_other_s_results_alone() -> None:
    x, doubled, squared = (torch.zeros(1024, device="cuda") for _ in range(3))
    capture = graphs.cuda_graphs(torch.device("cuda", 0))
    double = capture(lambda: doubled.copy_(x + x.clone()))  # type: ignore[arg-type, return-value]
    square = capture(lambda: squared.copy_(x * x.clone()))  # type: ignore[arg-type, return-value]
    for value in (3.0, 5.0):
        x.fill_(value)
        double()
        square()
        assert (doubled == 2 * value).all()
        assert (squared == value * value).all()
