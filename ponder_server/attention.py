"""Attention of a few new tokens over all tokens before them, reading the cache in place.

The queries are always the *last* positions, so no mask is needed: all of them attend to the past, and among themselves
they are causal. The two parts are computed separately and merged by their log-sum-exp, which is exact. A mask would be
queries x context floats per fire, and repeating the key heads would copy the whole cache.

In bfloat16 a CPU multiplies several times as fast, but torch's attention uses many small products, which do not gain.
`attend_in_windows` computes the same sums in a few large products.

Both ways are divided into pieces, by key heads and windows, for one or several threads: attention over a long past is
the only part of a fire that is large enough to parallelise.

# H query heads, G key heads, H = G * group; M queries, S positions, P = S - M past ones, D head dimension
# N products of R rows, the queries of one or several heads that share a key head; W positions of a window
"""

from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from dual_system.models.bfloat16 import HAS_FAST_BFLOAT16
from ponder_server.threads import ALONE, Threads

# Internal, but the only CPU attention that returns its log-sum-exp; the tests compare it with the public function.
_flash_cpu: Any = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu

SHIFT = 38.0
"""Subtracted from every score of :func:`attend_in_windows`."""
_MIN_TOTAL, _MAX_TOTAL = 1e-30, 2.0**-9
"""Valid sums of a query's shifted exponentials: below, small terms underflow; above, sigmoid is not exp."""
_WINDOW_STEP = 256
_ROWS = 1024
"""Largest number of rows in a product unless one head has more: attention weights of a long window take memory."""
_LEAST_WORK = 2**21
"""Elements of the queries times positions below which more calls or a second thread cost more than they save."""


def attend(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor, threads: Threads = ALONE) -> Tensor:
    """Attention output (H, M, D) of the last M of S positions; scores are scaled by D ** -0.5.

    The result is bit-identical for any number of ``threads``, which are used on a CPU only.
    """
    if queries_HMD.device.type != "cpu":
        return attend_masked(queries_HMD, keys_GSD, values_GSD)
    if queries_HMD.dtype == torch.bfloat16 and HAS_FAST_BFLOAT16:
        seen_HMD = attend_in_windows(queries_HMD, keys_GSD, values_GSD, threads)
        if seen_HMD is not None:
            return seen_HMD
    return attend_in_parts(queries_HMD, keys_GSD, values_GSD, threads)


def attend_in_parts(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor, threads: Threads = ALONE) -> Tensor:
    """`attend` on a CPU: past and present separately, without copying the past."""
    num_heads, num_queries, head_dim = queries_HMD.shape
    num_key_heads, num_past = keys_GSD.shape[0], keys_GSD.shape[1] - num_queries
    group = num_heads // num_key_heads
    recent_keys = keys_GSD[:, num_past:].repeat_interleave(group, dim=0)
    recent_values = values_GSD[:, num_past:].repeat_interleave(group, dim=0)
    recent, recent_lse = _flash_cpu(queries_HMD[None], recent_keys[None], recent_values[None], is_causal=True)
    if num_past == 0:
        return recent[0]  # type: ignore[no-any-return]
    # Without a mask queries are interchangeable: the heads that share a key head form one longer list of queries.
    shared = queries_HMD.reshape(1, num_key_heads, group * num_queries, head_dim)
    past, past_lse = torch.empty_like(shared), torch.empty(1, num_key_heads, group * num_queries)

    def look_back(heads: slice) -> None:
        seen = _flash_cpu(shared[:, heads], keys_GSD[None, heads, :num_past], values_GSD[None, heads, :num_past])
        past[:, heads], past_lse[:, heads] = seen

    is_large = threads.count > 1 and queries_HMD.numel() * num_past >= _LEAST_WORK
    pieces = [slice(head, head + 1) for head in range(num_key_heads)] if is_large else [slice(None)]
    threads.do(partial(look_back, heads) for heads in pieces)
    past = past.reshape(num_heads, num_queries, head_dim)
    share = torch.sigmoid(past_lse.reshape(num_heads, num_queries) - recent_lse[0])[..., None]
    return torch.lerp(recent[0].float(), past.float(), share).to(queries_HMD.dtype)


def attend_in_windows(
    queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor, threads: Threads = ALONE
) -> Tensor | None:
    """`attend` in bfloat16 on a CPU; None if `attend_in_parts` is faster or scores are too far from zero.

    The product of queries and keys is fused with the exponential, so that it is not rounded in between. torch fuses
    only the logistic function, which equals the exponential far below zero, where :data:`SHIFT` moves the scores.

    Two windows of equal length cover all positions. They overlap, and the second one skips what the first has seen:
    lengths are multiples of a step, so that a growing context seldom needs a product of a new shape, which is slower.
    """
    num_heads, num_queries, head_dim = queries_HMD.shape
    num_positions = keys_GSD.shape[1]
    window = -(-num_positions // (2 * _WINDOW_STEP)) * _WINDOW_STEP
    # The first window must lie in the past.
    if window > num_positions - num_queries or queries_HMD.numel() * num_positions < _LEAST_WORK:
        return None
    group = num_heads // keys_GSD.shape[0]
    num_shared = max(n for n in range(1, group + 1) if group % n == 0 and n * min(num_queries, _ROWS) <= _ROWS)
    scaled_NRD = (queries_HMD * head_dim**-0.5).reshape(-1, num_shared * num_queries, head_dim)
    shift_W = scaled_NRD.new_full((window,), -SHIFT)
    is_visible_MM = scaled_NRD.new_ones(num_queries, num_queries).tril_()
    seen_2NRD = torch.empty(2, *scaled_NRD.shape, dtype=queries_HMD.dtype)
    total_2NR1 = torch.empty(*seen_2NRD.shape[:-1], 1)

    def look_into(part: int, index: int) -> None:
        head, first = index * num_shared // group, part * (num_positions - window)
        here = slice(first, first + window)
        shares_RW = torch.ops.mkldnn._linear_pointwise(
            scaled_NRD[index], keys_GSD[head, here], shift_W, "sigmoid", [], ""
        )
        if first:
            shares_RW[:, : window - first] = 0
            shares_RW.view(num_shared, num_queries, window)[..., window - num_queries :] *= is_visible_MM
        seen_2NRD[part, index] = shares_RW @ values_GSD[head, here]
        # Two stages, because bfloat16 sums are rounded.
        total_2NR1[part, index] = shares_RW.unflatten(1, (-1, _WINDOW_STEP)).sum(-1).sum(-1, True, dtype=torch.float32)

    threads.do(partial(look_into, part, index) for index in range(len(scaled_NRD)) for part in (0, 1))
    total_NR1 = total_2NR1.sum(0)
    least, most = total_NR1.aminmax()
    if not (least >= _MIN_TOTAL and most <= _MAX_TOTAL):
        return None
    return (seen_2NRD.sum(0, dtype=torch.float32) / total_NR1).to(queries_HMD.dtype).view(queries_HMD.shape)


def attend_masked(queries_HMD: Tensor, keys_GSD: Tensor, values_GSD: Tensor) -> Tensor:
    """`attend` in one call of the public function, for devices whose kernels read a mask cheaply.

    The heads that share a key head become rows of one: torch's kernels with masks do not support grouped heads.
    """
    num_queries, num_positions = queries_HMD.shape[1], keys_GSD.shape[1]
    group = len(queries_HMD) // len(keys_GSD)
    visible_MS = torch.ones(num_queries, num_positions, dtype=torch.bool, device=queries_HMD.device)
    visible_MS = visible_MS.tril_(diagonal=num_positions - num_queries)
    rows_GRD = queries_HMD.reshape(len(keys_GSD), group * num_queries, -1)
    seen_1GRD = F.scaled_dot_product_attention(
        rows_GRD[None], keys_GSD[None], values_GSD[None], attn_mask=visible_MS.repeat(group, 1)
    )
    return seen_1GRD[0].unflatten(1, (group, num_queries)).flatten(0, 1)
