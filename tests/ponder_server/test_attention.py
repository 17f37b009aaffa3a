"""The two ways to attend are one function: parts joined by their log-sum-exp, and one call with a mask."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ponder_server.attention import attend_in_parts, attend_masked


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


def test_the_newest_position_does_not_reach_an_earlier_query() -> None:
    queries, keys, values = torch.randn(3, 2, 5, 32, generator=torch.Generator().manual_seed(0))
    changed = values.clone()
    changed[:, -1] += 1.0
    before, after = attend_in_parts(queries, keys, values), attend_in_parts(queries, keys, changed)
    assert torch.equal(before[:, :-1], after[:, :-1])
    assert not torch.equal(before[:, -1], after[:, -1])
