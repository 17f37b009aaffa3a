"""A kernel's time is that of replays of a graph; what else it is worth is its trial's (tests/ponder_server)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from dual_system.models.kernels import launch
from dual_system.models.kernels.launch import REPEATS, REPLAYS, cuda_time_ms


class FakeGpu:
    """A GPU that captures, and on whose clock each replay takes the next of these durations."""

    def __init__(self, *durations_ms: float) -> None:
        self.durations_ms = iter(durations_ms)
        self.now_ms = 0.0
        self.stream, self.streams, self.is_capturing = "own", 0, False
        self.ran: list[str] = []

    def work(self) -> None:
        self.ran.append(f"captured on {self.stream}" if self.is_capturing else f"launched on {self.stream}")

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        fakes: dict[str, Callable[..., object]] = {
            "current_device": lambda: 0,
            "current_stream": lambda: SimpleNamespace(wait_stream=lambda other: None),
            "Stream": self.new_stream,
            "stream": self.on,
            "CUDAGraph": lambda: SimpleNamespace(replay=self.replay),
            "graph": self.capture,
            "Event": self.event,
        }
        for name, fake in fakes.items():
            monkeypatch.setattr(torch.cuda, name, fake)

    def new_stream(self, device: int) -> SimpleNamespace:
        self.streams += 1
        return SimpleNamespace(name="side", wait_stream=lambda other: None)

    @contextmanager
    def on(self, stream: SimpleNamespace) -> Iterator[None]:
        before, self.stream = self.stream, stream.name
        try:
            yield
        finally:
            self.stream = before

    @contextmanager
    def capture(self, graph: object, stream: SimpleNamespace) -> Iterator[None]:
        """As torch's: if the work raises, the capture's stream stays the current one."""
        self.is_capturing, self.stream = True, stream.name
        try:
            yield
        finally:
            self.is_capturing = False

    def replay(self) -> None:
        self.now_ms += next(self.durations_ms)

    def event(self, *, enable_timing: bool) -> SimpleNamespace:
        event = SimpleNamespace(at_ms=0.0, synchronize=lambda: None)
        event.record = lambda: setattr(event, "at_ms", self.now_ms)
        event.elapsed_time = lambda end: end.at_ms - event.at_ms
        return event


@pytest.fixture(autouse=True)
def a_stream_of_its_own() -> Iterator[None]:
    launch._side.cache_clear()
    yield
    launch._side.cache_clear()


def test_only_replays_are_timed_and_the_first_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = FakeGpu(*[1.0] + [REPEATS * us for us in (7.0, 4.0, 9.0, 5.0, 6.0)])
    gpu.install(monkeypatch)
    assert cuda_time_ms(gpu.work) == 4.0
    assert gpu.ran == ["launched on side", *["captured on side"] * REPEATS]
    assert next(gpu.durations_ms, None) is None, f"there are {REPLAYS} after the first"


def test_all_timings_share_a_stream_and_one_that_fails_leaves_the_caller_s_current(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gpu = FakeGpu(*[1.0] * 2 * (1 + REPLAYS))
    gpu.install(monkeypatch)

    def waits() -> None:
        if gpu.is_capturing:
            raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match="not permitted"):
        cuda_time_ms(waits)
    assert gpu.stream == "own"
    for _ in range(2):
        cuda_time_ms(gpu.work)
    assert gpu.streams == 1


@pytest.mark.gpu
def test_ten_operations_take_longer_than_one() -> None:
    """Each is too small to be seen beside its launch, a host's matter."""
    x = torch.ones(4096, device="cuda")

    def times(count: int) -> Callable[[], None]:
        def work() -> None:
            for _ in range(count):
                x.mul_(1.0)

        return work

    one, ten = cuda_time_ms(times(1)), cuda_time_ms(times(10))
    memory = torch.cuda.memory_allocated()
    again = cuda_time_ms(lambda: x + x)
    assert 0 < one < ten / 3
    assert again < ten / 3
    assert torch.cuda.memory_allocated() == memory, "a graph's memory goes with it"
