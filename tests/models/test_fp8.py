"""fp8 layers: near the exact ones by their format's own law; the same numbers whoever takes the products."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from dual_system.models import fp8
from dual_system.models.fp8 import LEAST_CAPABILITY, Fp8Linear, has_products, missing_for
from dual_system.models.narrow_linear import quantise_where

MODEL_TYPE = torch.bfloat16


def linear_of(rows: int, columns: int, *, seed: int = 0, scale: float = 1.0, bias: bool = True) -> nn.Linear:
    linear = nn.Linear(columns, rows, bias=bias).requires_grad_(False)
    linear.weight.copy_(scale * torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed)))
    return linear


@given(seed=st.integers(0, 2**31), rows=st.integers(1, 9), columns=st.integers(1, 9), scale=st.floats(1e-6, 1e6))
@settings(deadline=None)
def test_no_weight_is_off_by_more_than_half_a_step_of_its_power_of_two(
    seed: int, rows: int, columns: int, scale: float
) -> None:
    """Three bits behind the leading one: a sixteenth of the weight; near zero, where there are no more powers, half of
    2**-9 of the row's scale."""
    linear = linear_of(rows, columns, seed=seed, scale=scale)
    narrow = Fp8Linear(linear)
    widened_OI = narrow.weight_OI.float() * narrow.scale_O[:, None]
    allowed = torch.maximum(linear.weight.abs() / 16, narrow.scale_O[:, None] * 2**-10)
    assert ((widened_OI - linear.weight).abs() <= 1.001 * allowed).all()
    largest = linear.weight.abs().amax(dim=1)
    torch.testing.assert_close(widened_OI.abs().amax(dim=1), largest)  # the largest is kept: the scale is its own
    torch.testing.assert_close(narrow(torch.eye(columns)), widened_OI.T + linear.bias)


def test_a_row_of_zeros_stays_one_and_the_smallest_numbers_make_no_others() -> None:
    linear = nn.Linear(3, 3, bias=False).requires_grad_(False)
    linear.weight.copy_(torch.tensor([[0.0] * 3, [1e-38] * 3, [1e-45, 0.0, 0.0]]))
    out = Fp8Linear(linear)(torch.ones(1, 3))
    assert out[0, 0] == 0
    assert out.isfinite().all()


def test_a_weight_takes_a_byte_and_only_what_was_asked_for_is_narrow() -> None:
    model = nn.Sequential(nn.Linear(4, 3), nn.Sequential(nn.Linear(3, 2), nn.LayerNorm(2)))
    assert quantise_where(model, lambda name: name == "1.0.weight", Fp8Linear) == 3 * 6
    assert [type(child) for child in (model[0], *model[1])] == [nn.Linear, Fp8Linear, nn.LayerNorm]
    narrow: Any = model[1][0]
    assert (narrow.weight_OI.dtype, narrow.weight_OI.nbytes) == (torch.float8_e4m3fn, 6)


@pytest.fixture
def with_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU that has them: torch's ``_scaled_mm`` runs on a CPU as well."""
    monkeypatch.setattr(fp8, "has_products", lambda device: True)


@pytest.mark.usefixtures("with_products")
@pytest.mark.parametrize("shape", [(5, 32), (1, 32), (2, 3, 32)])
def test_fp8_products_are_off_by_the_rounding_of_the_activations_alone(shape: tuple[int, ...]) -> None:
    """Each activation by a sixteenth at most, as the weights; then the sum once more, to bfloat16."""
    narrow = Fp8Linear(linear_of(48, 32))
    x = torch.randn(shape, generator=torch.Generator().manual_seed(3)).to(MODEL_TYPE)
    x[..., :1, :] *= 1000.0  # rows have scales of their own
    out = narrow(x)
    assert (out.dtype, out.shape) == (MODEL_TYPE, (*shape[:-1], 48))
    widened_OI = narrow.weight_OI.float() * narrow.scale_O[:, None]
    exact = x.float() @ widened_OI.T + narrow.bias
    allowed = x.float().abs() @ widened_OI.abs().T / 16 + exact.abs() / 100
    assert ((out.float() - exact).abs() <= allowed).all()
    assert (out.float() - exact).abs().max() > 0


@pytest.mark.usefixtures("with_products")
@pytest.mark.parametrize(
    ("rows", "columns", "dtype"), [(48, 31, MODEL_TYPE), (47, 32, MODEL_TYPE), (48, 32, torch.float32)]
)
def test_what_has_no_fp8_product_is_widened(rows: int, columns: int, dtype: torch.dtype) -> None:
    narrow = Fp8Linear(linear_of(rows, columns))
    x = torch.randn(5, columns, generator=torch.Generator().manual_seed(3)).to(dtype)
    widened_OI = narrow.weight_OI.float() * narrow.scale_O[:, None]
    tolerance = 1e-5 if dtype == torch.float32 else 0.2
    torch.testing.assert_close(narrow(x).float(), x.float() @ widened_OI.T + narrow.bias, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("capability", "has"), [((8, 0), False), ((8, 9), True), ((9, 0), True), ((10, 0), True)])
def test_products_need_a_gpu_that_is_new_enough_and_a_torch_that_can_ask_it(
    monkeypatch: pytest.MonkeyPatch, capability: tuple[int, int], has: bool
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    gpu = torch.device("cuda", 0)
    assert has_products(gpu) is has
    assert not has_products(torch.device("cpu"))
    monkeypatch.delattr(torch, "_scaled_mm")
    assert not has_products(gpu)


def test_where_there_can_be_none_it_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_for(torch.device("cpu")) == missing_for(torch.device("cuda")) == ""
    assert missing_for(torch.device("mps")) == "fp8 weights are for a CPU or a CUDA GPU, not for 'mps'"
    monkeypatch.delattr(torch, "float8_e4m3fn")
    assert missing_for(torch.device("cpu")) == f"torch {torch.__version__} has no float8_e4m3fn"


@pytest.mark.gpu
def test_a_gpu_s_products_are_those_of_the_widened_weights() -> None:
    if not has_products(torch.device("cuda")):
        pytest.skip(f"needs fp8 products, {LEAST_CAPABILITY} or newer; came {torch.cuda.get_device_capability()}")
    narrow = Fp8Linear(linear_of(64, 128).to("cuda"))
    x = torch.randn(17, 128, device="cuda", dtype=MODEL_TYPE)
    exact = x.float() @ (narrow.weight_OI.float() * narrow.scale_O[:, None]).T + narrow.bias
    assert (narrow(x).float() - exact).norm() / exact.norm() < 0.05
