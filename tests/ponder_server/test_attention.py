"""The ways to attend are one: with a mask, in parts joined by log-sum-exp, in two windows; on any number of threads."""

from collections.abc import Iterable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.bfloat16 import HAS_FAST_BFLOAT16
from ponder_server.attention import (
    attend,
    attend_in_parts,
    attend_in_windows,
    attend_masked,
)
from ponder_server.threads import Piece, Threads

needs_fast_bfloat16 = pytest.mark.skipif(not HAS_FAST_BFLOAT16, reason="torch has no fast bfloat16 on this CPU")


@settings(deadline=None, max_examples=30)
@given(
    key_heads=st.integers(1, 3),
    group=st.integers(1, 4),
    num_queries=st.integers(1, 70),
    num_past=st.integers(0, 600),
    seed=st.integers(0, 99),
)
def test_past_and_present_apart_are_attention_with_a_mask(
    key_heads: int, group: int, num_queries: int, num_past: int, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    queries = 3.0 * torch.randn(key_heads * group, num_queries, 32, generator=generator)
    keys, values = torch.randn(2, key_heads, num_past + num_queries, 32, generator=generator)
    apart = attend_in_parts(queries, keys, values)
    torch.testing.assert_close(apart, attend_masked(queries, keys, values), rtol=0, atol=1e-5)


def test_with_a_mask_no_call_has_grouped_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's fused GPU kernels refuse the two together."""
    calls, real = [], F.scaled_dot_product_attention

    def watched(query: Tensor, key: Tensor, value: Tensor, **options: Any) -> Tensor:
        calls.append((query.shape[1] == key.shape[1], options.get("enable_gqa", False)))
        return real(query, key, value, **options)

    queries, keys = torch.randn(6, 5, 32), torch.randn(2, 9, 32)
    expected = real(queries[None], keys[None], keys[None], torch.ones(5, 9).tril(4).bool(), enable_gqa=True)[0]
    monkeypatch.setattr(F, "scaled_dot_product_attention", watched)
    torch.testing.assert_close(attend_masked(queries, keys, keys), expected, rtol=0, atol=1e-6)
    assert calls == [(True, False)]


def test_the_newest_position_does_not_reach_an_earlier_query() -> None:
    queries, keys, values = torch.randn(3, 2, 5, 32, generator=torch.Generator().manual_seed(0))
    changed = values.clone()
    changed[:, -1] += 1.0
    before, after = attend_in_parts(queries, keys, values), attend_in_parts(queries, keys, changed)
    assert torch.equal(before[:, :-1], after[:, :-1])
    assert not torch.equal(before[:, -1], after[:, -1])


def rounded(
    key_heads: int, group: int, num_queries: int, num_past: int, head_dim: int, *, scale: float = 1.0, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """Queries, of which a larger ``scale`` looks at fewer positions, keys and values, in bfloat16."""
    generator = torch.Generator().manual_seed(seed)
    queries = scale * torch.randn(key_heads * group, num_queries, head_dim, generator=generator)
    keys, values = torch.randn(2, key_heads, num_past + num_queries, head_dim, generator=generator)
    return queries.bfloat16(), keys.bfloat16(), values.bfloat16()


def error(actual: Tensor, arguments: tuple[Tensor, Tensor, Tensor]) -> float:
    expected = attend_masked(*(argument.float() for argument in arguments))
    return float((actual.float() - expected).norm() / expected.norm())


@needs_fast_bfloat16
@settings(deadline=None, max_examples=20, derandomize=True)
@given(
    key_heads=st.integers(1, 2),
    group=st.integers(1, 4),
    num_queries=st.integers(1, 400),
    num_past=st.integers(0, 1500),
    head_dim=st.sampled_from([64, 256]),
    scale=st.floats(0.3, 4.0),
    seed=st.integers(0, 99),
)
def test_two_windows_err_as_torchs_own_bfloat16_does(
    key_heads: int, group: int, num_queries: int, num_past: int, head_dim: int, scale: float, seed: int
) -> None:
    arguments = rounded(key_heads, group, num_queries, num_past, head_dim, scale=scale, seed=seed)
    actual = attend_in_windows(*arguments)
    assume(actual is not None)
    assert actual is not None
    assert error(actual, arguments) < 1.6 * error(attend_in_parts(*arguments), arguments)


@needs_fast_bfloat16
@pytest.mark.parametrize(
    ("offset", "is_taken"), [(0.0, True), (20.0, True), (-20.0, True), (50.0, False), (-90.0, False)]
)
def test_scores_far_from_zero_are_left_to_the_other_way(offset: float, is_taken: bool) -> None:
    """One number more in each query and key adds the same to every score."""
    queries, keys, values = rounded(1, 2, 40, 1000, 64)
    queries[..., 0], keys[..., 0] = 8.0, offset
    arguments = queries, keys, values
    assert (attend_in_windows(*arguments) is not None) == is_taken
    assert error(attend(*arguments), arguments) < 1.6 * error(attend_in_parts(*arguments), arguments)


@needs_fast_bfloat16
def test_in_windows_too_the_newest_position_does_not_reach_an_earlier_query() -> None:
    queries, keys, values = rounded(2, 2, 60, 700, 64)
    queries = queries.transpose(0, 1).contiguous().transpose(0, 1)  # token by token, as the decoder's are
    changed = values.clone()
    changed[:, -1] += 1.0
    before, after = attend_in_windows(queries, keys, values), attend_in_windows(queries, keys, changed)
    assert before is not None
    assert after is not None
    assert torch.equal(before[:, :-1], after[:, :-1])
    assert not torch.equal(before[:, -1], after[:, -1])


# -- on several threads


class Watched(Threads):
    """Counts the pieces."""

    num_pieces = 0

    def do(self, pieces: Iterable[Piece]) -> None:
        pieces = list(pieces)
        self.num_pieces += len(pieces)
        super().do(pieces)


TWO, THREE = Threads(2), Threads(3)


@settings(deadline=None, max_examples=25)
@given(
    dtype=st.sampled_from([torch.float32, torch.bfloat16]),
    key_heads=st.integers(1, 3),
    group=st.integers(1, 4),
    num_queries=st.integers(1, 300),
    num_past=st.integers(0, 3000),
    seed=st.integers(0, 99),
)
@example(dtype=torch.float32, key_heads=2, group=2, num_queries=133, num_past=2500, seed=0)
@example(dtype=torch.bfloat16, key_heads=2, group=2, num_queries=133, num_past=2500, seed=0)
@example(dtype=torch.bfloat16, key_heads=1, group=1, num_queries=133, num_past=2500, seed=0)
def test_no_bit_depends_on_the_number_of_threads(
    dtype: torch.dtype, key_heads: int, group: int, num_queries: int, num_past: int, seed: int
) -> None:
    arguments = rounded(key_heads, group, num_queries, num_past, 32, seed=seed)
    queries, keys, values = (tensor.to(dtype) for tensor in arguments)
    alone = attend(queries, keys, values)
    for threads in (TWO, THREE):
        assert torch.equal(attend(queries, keys, values, threads), alone)


@pytest.mark.parametrize(("dtype", "num_pieces"), [(torch.float32, 2), (torch.bfloat16, 4)])
def test_only_a_large_past_is_shared_out(dtype: torch.dtype, num_pieces: int) -> None:
    """Two key heads, in bfloat16 in two windows each; a token of text is not worth a second thread's waking up."""
    if dtype == torch.bfloat16 and not HAS_FAST_BFLOAT16:
        num_pieces = 2
    queries, keys, values = (tensor.to(dtype) for tensor in rounded(2, 2, 133, 2500, 32))
    threads = Watched(2)
    attend(queries, keys, values, threads)
    assert threads.num_pieces == num_pieces
    attend(queries[:, -1:], keys, values, threads)
    assert threads.num_pieces == num_pieces + 1
