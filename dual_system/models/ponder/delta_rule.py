"""Gated DeltaNet's rules in plain torch: over many tokens in chunks, and over one.

Both know grouped heads, which not every transformers version's own do, so none of theirs is called. transformers' loop
over chunks also reads and writes slices of whole tensors, and the gradient of a slice is a zero tensor of full size:
its cost grows with the square of the number of chunks. Here the chunks are unbound once, only the state's recurrence is
in the loop, and the outputs of all chunks are computed at once. The chunk's triangular system is solved by
substitution: a product of its powers, (I + N)(I + N^2)..., would cancel large terms wherever keys repeat.

# B rows, T tokens, K key heads, V value heads, G = V / K, X = B V, N chunks, C tokens of a chunk
# D key and E value dimensions
"""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor
from torch.nn import functional as F

CHUNK = 32
GPU_CHUNK = 64
"""Twice the CPU's: on a GPU the loop is bound by kernel launches, so fewer iterations are faster. A short append is one
chunk without padding."""


def gated_delta_rule(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    g: Tensor,
    beta: Tensor,
    initial_state: Tensor | None = None,
    chunk_size: int | None = None,
) -> tuple[Tensor, Tensor]:
    """S_t = exp(g_t) (I - beta_t k_t k_t^T) S_{t-1} + beta_t k_t v_t^T, read by q_t; float32 inside, autocast or not.

    The tests compare it with transformers' ``torch_chunk_gated_delta_rule``.

    Args:
        query, key: (B, T, K, D), scaled to length 1 first; value head h reads key head h // G.
        value: (B, T, V, E).
        g: log decay (B, T, V), at most 0.
        beta: (B, T, V).
        initial_state: (B, V, D, E); zero if None.
        chunk_size: tokens of a chunk; None takes the device's.

    Returns:
        Outputs (B, T, V, E) in the dtype of ``query``, and the final state (B, V, D, E) float32.
    """
    return _prepared(query, key, value, g, beta, initial_state, chunk_size, None)[:2]


def gated_delta_keeping(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    g: Tensor,
    beta: Tensor,
    initial_state: Tensor,
    num_kept_B: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The rule for T tokens or one, and the state after each row's first ``num_kept_B`` (B,) of them; None without it.

    That state has the bits of the final one of these tokens alone, if they are padded to as many chunks.
    """
    if query.shape[1] == 1:
        read, state = gated_delta_step(query, key, value, g, beta, initial_state)
        return read, state, None if num_kept_B is None else state
    return _prepared(query, key, value, g, beta, initial_state, None, num_kept_B)


def _prepared(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    g: Tensor,
    beta: Tensor,
    initial_state: Tensor | None,
    chunk_size: int | None,
    num_kept_B: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    if chunk_size is None:
        chunk_size = min(GPU_CHUNK, query.shape[1]) if query.is_cuda else CHUNK
    with _without_autocast(query.device):
        read, state, kept = _rule(
            *(_of_length_1(query), _of_length_1(key), value.float(), g.float(), beta.float()),
            *(chunk_size, initial_state, num_kept_B),
        )
    return read.to(query.dtype), state, kept


def _rule(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    g: Tensor,
    beta: Tensor,
    chunk: int,
    state: Tensor | None,
    num_kept_B: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    batch, length, key_heads, key_dim = key.shape
    value_heads, value_dim = value.shape[2:]
    padding = -length % chunk
    num_chunks = (length + padding) // chunk

    def chunks(x_BTHD: Tensor, heads: tuple[int, int]) -> Tensor:
        """Returns (N, B, K, G or 1, C, D). Padding is zero: it neither writes to the state nor decays it."""
        padded = F.pad(x_BTHD, (0, 0, 0, 0, 0, padding)).view(batch, num_chunks, chunk, *heads, -1)
        return padded.permute(1, 0, 3, 4, 2, 5).contiguous()

    grouped = (key_heads, value_heads // key_heads)
    queries, keys = chunks(query * key_dim**-0.5, (key_heads, 1)), chunks(key, (key_heads, 1))
    values, betas = chunks(value, grouped), chunks(beta[..., None], grouped)
    since_start = chunks(g[..., None], grouped).cumsum(-2)
    until_end = since_start[..., -1:, :] - since_start
    future = torch.ones(chunk, chunk, dtype=torch.bool, device=key.device).triu(1)
    # Masked before exp: future entries could overflow, and infinity times zero is NaN.
    decay = (since_start - since_start.transpose(-1, -2)).masked_fill(future, float("-inf")).exp()

    system = (keys @ keys.transpose(-1, -2)) * decay * betas
    wanted = torch.cat([values * betas, keys * (betas * since_start.exp())], dim=-1)
    solved = torch.linalg.solve_triangular(system, wanted, upper=False, unitriangular=True)
    written, erased = solved.flatten(1, 3).split([value_dim, key_dim], dim=-1)  # (N, B V, C, E), (N, B V, C, D)
    writing = (keys * until_end.exp()).flatten(1, 3).transpose(-1, -2)
    kept = since_start[..., -1:, :].exp().flatten(1, 3)

    if state is None:
        state = value.new_zeros(batch, value_heads, key_dim, value_dim)
    state = state.float().reshape(-1, key_dim, value_dim)
    states, news = [], []
    for u, w, k, keep in zip(written.unbind(), erased.unbind(), writing.unbind(), kept.unbind(), strict=True):
        new = torch.baddbmm(u, w, state, alpha=-1)
        states.append(state)
        news.append(new)
        state = torch.baddbmm(state * keep, k, new)
    attention = ((queries @ keys.transpose(-1, -2)) * decay).flatten(1, 3)
    reading = (queries * since_start.exp()).flatten(1, 3)
    states_NXDE, news_NXCE = torch.stack(states), torch.stack(news)
    read = reading @ states_NXDE + attention @ news_NXCE
    read_BNCVE = read.view(num_chunks, batch, value_heads, chunk, value_dim).permute(1, 0, 3, 2, 4)
    read_BTVE = read_BNCVE.reshape(batch, num_chunks * chunk, value_heads, value_dim)[:, :length]
    kept_BVDE = None
    if num_kept_B is not None:
        chunk_B = (num_kept_B // chunk).clamp(max=num_chunks - 1)
        at = chunk_B, torch.arange(batch, device=key.device)
        start_BVDE, new_BVCE = (x.unflatten(1, (batch, value_heads))[at] for x in (states_NXDE, news_NXCE))
        kept_BVDE = _as_if_ended(keys[at], since_start[at], start_BVDE, new_BVCE, num_kept_B - chunk_B * chunk)
    return read_BTVE, state.view(batch, value_heads, key_dim, value_dim), kept_BVDE


def _as_if_ended(
    keys_BK1CD: Tensor, since_start_BKGC1: Tensor, start_BVDE: Tensor, new_BVCE: Tensor, count_B: Tensor
) -> Tensor:
    """The state (B, V, D, E) after a chunk's first ``count_B`` tokens, from the state at its start."""
    count_B111 = count_B[:, None, None, None]
    sums_BVC1 = since_start_BKGC1.flatten(1, 2)
    last_BV11 = sums_BVC1.gather(2, (count_B111 - 1).clamp(min=0).expand(-1, sums_BVC1.shape[1], 1, 1))
    is_later_B1C1 = torch.arange(sums_BVC1.shape[2], device=count_B.device)[:, None] >= count_B111
    # Masked before exp: what is later could overflow.
    weights_BVC1 = (last_BV11 - sums_BVC1).masked_fill(is_later_B1C1, float("-inf")).exp()
    keys_BVCD = keys_BK1CD.expand(-1, -1, since_start_BKGC1.shape[2], -1, -1).flatten(1, 2)
    kept_XDE = torch.baddbmm(
        (start_BVDE * last_BV11.masked_fill(count_B111 == 0, 0.0).exp()).flatten(0, 1),
        (keys_BVCD * weights_BVC1).flatten(0, 1).transpose(-1, -2),
        new_BVCE.flatten(0, 1),
    )
    return kept_XDE.view(start_BVDE.shape)


def gated_delta_step(
    query: Tensor, key: Tensor, value: Tensor, g: Tensor, beta: Tensor, initial_state: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """:func:`gated_delta_rule` for T = 1, by the recurrence itself. On a CPU its bits are transformers' own."""
    assert query.shape[1] == 1, "a step takes one token"
    key_heads, key_dim = key.shape[2:]
    batch, _, value_heads, value_dim = value.shape
    grouped = (key_heads, value_heads // key_heads)
    q_BK1D1, k_BK1D1 = (_of_length_1(x[:, 0])[:, :, None, :, None] for x in (query, key))
    q_BK1D1 = q_BK1D1 / key_dim**0.5
    v_BKGE, g_BKG, beta_BKG = (x[:, 0].float().unflatten(1, grouped) for x in (value, g, beta))
    if initial_state is None:
        initial_state = v_BKGE.new_zeros(batch, value_heads, key_dim, value_dim)
    state = initial_state.float().unflatten(1, grouped) * g_BKG.exp()[..., None, None]
    written_BKGE = (v_BKGE - (state * k_BK1D1).sum(-2)) * beta_BKG[..., None]
    state = state + k_BK1D1 * written_BKGE[..., None, :]
    read_B1VE = (state * q_BK1D1).sum(-2).flatten(1, 2)[:, None]
    return read_B1VE.to(query.dtype), state.flatten(1, 2)


def _of_length_1(x: Tensor) -> Tensor:
    x = x.float()
    return x * torch.rsqrt(x.square().sum(-1, keepdim=True) + 1e-6)


def _without_autocast(device: torch.device) -> AbstractContextManager[object]:
    return nullcontext() if device.type == "meta" else torch.autocast(device.type, enabled=False)
