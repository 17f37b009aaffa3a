"""fp8's kernels against their twins, in the interpreter: rows, the norm of rows, and products of few rows."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.kernels.fp8 import (
    FEW_ROWS,
    Quantised,
    few_rows_eager,
    few_rows_fused,
    quantise_eager,
    quantise_fused,
)
from dual_system.models.kernels.launch import missing_for
from dual_system.models.kernels.rms_norm import Residual, Style, norm_eager, norm_fused

LACK = missing_for(torch.device("cpu"))
pytestmark = [pytest.mark.skipif(bool(LACK), reason=LACK), pytest.mark.usefixtures("rounding_interpreter")]
few = settings(max_examples=10)
NAN = float("nan")
seeds = st.integers(0, 2**32 - 1)


def drawn(seed: int, *shape: int, dtype: torch.dtype = torch.bfloat16) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(dtype)


def same(came: Quantised, expected: Quantised) -> None:
    assert torch.equal(came.scale_M, expected.scale_M)
    assert torch.equal(came.narrow_MI.view(torch.uint8), expected.narrow_MI.view(torch.uint8))


@few
@given(st.integers(1, 4), st.integers(1, 40), st.sampled_from([1e-30, 1.0, 1e30]), seeds)
def test_rows_are_quantised_bit_for_bit(num_rows: int, width: int, scale: float, seed: int) -> None:
    x = drawn(seed, num_rows, width) * scale
    x[0] = 0.0
    same(quantise_fused(x), quantise_eager(x))


@pytest.mark.filterwarnings("ignore:invalid value")
def test_what_is_no_number_stays_none() -> None:
    """A broken network must be seen, not served."""
    x = drawn(0, 3, 20)
    x[0, 3], x[1, 4] = NAN, float("inf")
    narrow = quantise_fused(x).narrow_MI.float()
    assert narrow[0, 3].isnan()
    assert narrow[1, 4].isnan()
    assert narrow[2].isfinite().all()


@few
@given(st.integers(1, 3), st.integers(1, 40), st.booleans(), seeds)
def test_a_norm_gives_what_its_rows_quantised_give(num_rows: int, width: int, has_branch: bool, seed: int) -> None:
    """What is stored in bfloat16 is quantised, so that both are one number. Outputs are NaN before."""
    x, style = drawn(seed, num_rows, width), Style(drawn(seed + 1, width, dtype=torch.float32))
    residual = Residual(drawn(seed + 2, num_rows, width)) if has_branch else None
    outs = []
    for norm in (norm_fused, norm_eager):
        out, rows = torch.full_like(x, NAN), Quantised.blank(x)
        rows.scale_M.fill_(NAN)
        rows.narrow_MI.view(torch.uint8).fill_(0x7F)
        norm(x.clone(), out, style, residual, rows)
        same(rows, quantise_eager(out))
        outs.append(out)
    torch.testing.assert_close(*outs, rtol=2**-7, atol=2**-6)


@few
@given(st.integers(1, FEW_ROWS), st.sampled_from([16, 40, 300]), st.integers(1, 40), seeds)
def test_few_rows_times_fp8_weights(num_rows: int, width: int, num_outputs: int, seed: int) -> None:
    """In float32: the interpreter multiplies bfloat16 wrongly. Memory behind the rows is NaN."""
    weight, scale = quantise_eager(drawn(seed, num_outputs, width))
    memory = torch.full((num_rows + 3, width), NAN)
    memory[:num_rows] = drawn(seed + 1, num_rows, width, dtype=torch.float32)
    x = memory[:num_rows]
    torch.testing.assert_close(few_rows_fused(x, weight, scale), few_rows_eager(x, weight, scale), rtol=1e-5, atol=1e-4)


def test_more_rows_than_a_tile_are_refused() -> None:
    weight, scale = quantise_eager(drawn(0, 4, 16))
    with pytest.raises(ValueError, match="expected at most 16 rows, came 17"):
        few_rows_fused(drawn(1, 17, 16), weight, scale)
