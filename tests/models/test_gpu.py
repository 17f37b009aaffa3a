"""What a GPU needs of the process, on a machine without one: torch's switches are there in any build."""

from collections.abc import Iterator

import pytest
import torch

from dual_system.models import gpu
from dual_system.models.ponder.configs import qwen35_9b
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.initialise import random_pounce


@pytest.fixture(autouse=True)
def switches() -> Iterator[None]:
    products, convolutions = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    plans = torch.backends.cuda.cudnn_sdp_enabled()
    yield
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = products, convolutions
    torch.backends.cuda.enable_cudnn_sdp(plans)


def now() -> tuple[bool, bool, bool]:
    cuda = torch.backends.cuda
    return cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32, cuda.cudnn_sdp_enabled()


def test_float32_is_float32_on_a_gpu_and_no_attention_is_planned_by_shape() -> None:
    before = now()
    assert before[1:] == (True, True), "torch's defaults"
    gpu.settle(torch.device("cpu"))
    assert now() == before
    gpu.settle(torch.device("cuda", 1))
    assert now() == (False, False, False)
    gpu.settle(torch.device("cuda", 1), tf32=True)
    assert now() == (True, True, False)


def test_the_current_gpu_is_the_network_s() -> None:
    here = gpu.current(torch.device("cuda", 1))
    assert isinstance(here, torch.cuda.device)
    assert here.idx == 1
    assert not isinstance(gpu.current(torch.device("cpu")), torch.cuda.device)


def test_weights_are_drawn_where_they_will_lie(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    real = torch.Generator
    monkeypatch.setattr(torch, "Generator", lambda device="cpu": asked.append(device) or real())  # type: ignore[func-returns-value]
    for device in ("cpu", "cuda:1"):
        gpu.generator_for(torch.device(device), 0)
    random_pounce(tiny_cpu(), 0)
    assert asked == ["cpu", torch.device("cuda", 1), "cpu"]


def test_a_network_without_memory_draws_nothing() -> None:
    """The 9B's weights would take three minutes."""
    assert Ponder.random(qwen35_9b(), seed=0, device="meta").hidden_size == 4096
