"""The choice of a library per product: timed once, kept for this machine, and the product is the same by any."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu
from pounce_server.engine import EagerEngine
from pounce_server.kernels.choice import LIBRARIES, Choices, ChosenProduct, default_cache, product

CUBLAS, CUBLASLT = LIBRARIES


def anyhow(library: str) -> nullcontext[None]:
    """A CPU build of torch has one library."""
    return nullcontext()


@dataclass
class FakeTimer:
    """Runs the work once and gives the next of these times."""

    times: list[float]
    num_timed: int = field(default=0)

    def __call__(self, work: Callable[[], None]) -> float:
        work()
        self.num_timed += 1
        return self.times[(self.num_timed - 1) % len(self.times)]


def numbers(rows: int, inputs: int, outputs: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(rows)
    x, weight = torch.randn(rows, inputs, generator=generator), torch.randn(outputs, inputs, generator=generator)
    return x, weight, torch.full((rows, outputs), torch.nan)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "deep" / "products.json"


@given(rows=st.integers(1, 9), inputs=st.integers(1, 9), outputs=st.integers(1, 9))
def test_it_is_the_ordinary_product_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: int, inputs: int, outputs: int
) -> None:
    chosen = ChosenProduct(Choices(tmp_path_factory.mktemp("cache") / "products.json", "A"), FakeTimer([1.0]), anyhow)
    x, weight, out = numbers(rows, inputs, outputs)
    chosen(x, weight, out)
    plain = torch.empty_like(out)
    product(x, weight, plain)
    assert torch.equal(out, plain)
    assert torch.equal(out, x @ weight.T)


@pytest.mark.parametrize(("times", "winner"), [([2.0, 1.0], CUBLASLT), ([1.0, 2.0], CUBLAS), ([1.0, 1.0], CUBLAS)])
def test_the_fastest_wins_and_each_shape_is_timed_once(cache: Path, times: list[float], winner: str) -> None:
    timer = FakeTimer(times)
    chosen = ChosenProduct(Choices(cache, "A"), timer, anyhow)
    for _ in range(3):
        chosen(*numbers(2, 3, 4))
    assert timer.num_timed == len(LIBRARIES)
    chosen(*numbers(5, 3, 4))
    assert timer.num_timed == 2 * len(LIBRARIES)
    assert json.loads(cache.read_text()) == {"A": {"float32 2x3x4": winner, "float32 5x3x4": winner}}


def test_the_next_process_times_nothing_and_another_machine_its_own(cache: Path) -> None:
    ChosenProduct(Choices(cache, "A"), FakeTimer([2.0, 1.0]), anyhow)(*numbers(2, 3, 4))
    again, other = FakeTimer([1.0, 2.0]), FakeTimer([1.0, 2.0])
    ChosenProduct(Choices(cache, "A"), again, anyhow)(*numbers(2, 3, 4))
    ChosenProduct(Choices(cache, "B"), other, anyhow)(*numbers(2, 3, 4))
    assert (again.num_timed, other.num_timed) == (0, 2)
    assert json.loads(cache.read_text()) == {"A": {"float32 2x3x4": CUBLASLT}, "B": {"float32 2x3x4": CUBLAS}}


def test_two_processes_keep_each_others_choices(cache: Path) -> None:
    first, second = Choices(cache, "A"), Choices(cache, "A")
    first.keep("x", CUBLAS)
    second.keep("y", CUBLASLT)
    assert json.loads(cache.read_text()) == {"A": {"x": CUBLAS, "y": CUBLASLT}}


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"A": 3}', '{"A": {"float32 2x3x4": "a library of the past"}}', "\0\1"]
)
def test_a_file_that_says_nothing_useful_is_begun_anew(cache: Path, content: str) -> None:
    cache.parent.mkdir()
    cache.write_text(content)
    timer = FakeTimer([2.0, 1.0])
    ChosenProduct(Choices(cache, "A"), timer, anyhow)(*numbers(2, 3, 4))
    assert timer.num_timed == 2
    assert Choices(cache, "A").get("float32 2x3x4") == CUBLASLT


def test_a_shape_is_multiplied_by_the_library_that_won_it(cache: Path) -> None:
    used: list[str] = []

    @contextmanager
    def noting(library: str) -> Iterator[None]:
        used.append(library)
        yield

    chosen = ChosenProduct(Choices(cache, "A"), FakeTimer([2.0, 1.0, 1.0, 2.0]), noting)
    for rows in (2, 5, 2, 5):
        chosen(*numbers(rows, 3, 4))
    assert used == [CUBLAS, CUBLASLT, CUBLASLT, CUBLAS, CUBLASLT, CUBLAS, CUBLASLT, CUBLAS]


def test_the_cache_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache() == tmp_path / "ponderpounce" / "products.json"


def test_autotune_without_the_fused_path_is_refused() -> None:
    with pytest.raises(ValueError, match="add --path fused"):
        EagerEngine(random_bundle(tiny_cpu(), seed=0), autotune=True)
