"""Gated DeltaNet in plain torch for training: transformers' result with a cheaper backward pass.

transformers' own loop over chunks reads and writes slices of whole tensors, and the gradient of a slice is a zero
tensor of full size: its cost grows with the square of the number of chunks. Here the chunks are unbound once, only the
state's recurrence is in the loop, and the outputs of all chunks are computed at once. The chunk's triangular system is
solved by substitution: a product of its powers, (I + N)(I + N^2)..., would cancel large terms wherever keys repeat.

# B rows, T tokens, K key heads, V value heads, G = V / K, N chunks, C tokens of a chunk, D key and E value dimensions
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F
from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5GatedDeltaNet, causal_conv1d_fn

from dual_system.models.ponder import mixers

CHUNK = 32
_GPU_CHUNK = 64
"""Twice the CPU's: on a GPU the loop is bound by kernel launches, so fewer iterations are faster."""


def gated_delta_rule(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    g: Tensor,
    beta: Tensor,
    chunk_size: int = CHUNK,
    initial_state: Tensor | None = None,
    output_final_state: bool = False,
    use_qk_l2norm_in_kernel: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """S_t = exp(g_t) (I - beta_t k_t k_t^T) S_{t-1} + beta_t k_t v_t^T, read by q_t; float32 inside, autocast or not.

    Arguments as in transformers' ``torch_chunk_gated_delta_rule``, with which the tests compare it.

    Args:
        query, key: (B, T, K, D); value head h reads key head h // G.
        value: (B, T, V, E).
        g: log decay (B, T, V), at most 0.
        beta: (B, T, V).
        initial_state: (B, V, D, E); zero if None.
        use_qk_l2norm_in_kernel: normalise queries and keys to length 1 first.

    Returns:
        Outputs (B, T, V, E) in the dtype of ``query``, and the final float32 state, or None unless requested.
    """
    with torch.autocast(query.device.type, enabled=False):
        read, state = _rule(
            query.float(), key.float(), value.float(), g.float(), beta.float(),
            chunk_size, initial_state, use_qk_l2norm_in_kernel,
        )  # fmt: skip
    return read.to(query.dtype), state if output_final_state else None


def _rule(
    query: Tensor, key: Tensor, value: Tensor, g: Tensor, beta: Tensor, chunk: int, state: Tensor | None, l2norm: bool
) -> tuple[Tensor, Tensor]:
    batch, length, key_heads, key_dim = key.shape
    value_heads, value_dim = value.shape[2:]
    padding = -length % chunk
    num_chunks = (length + padding) // chunk

    def chunks(x_BTHD: Tensor, heads: tuple[int, int]) -> Tensor:
        """Returns (N, B, K, G or 1, C, D). Padding is zero: it neither writes to the state nor decays it."""
        padded = F.pad(x_BTHD, (0, 0, 0, 0, 0, padding)).view(batch, num_chunks, chunk, *heads, -1)
        return padded.permute(1, 0, 3, 4, 2, 5).contiguous()

    if l2norm:
        query = query * torch.rsqrt(query.square().sum(-1, keepdim=True) + 1e-6)
        key = key * torch.rsqrt(key.square().sum(-1, keepdim=True) + 1e-6)
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
    read = reading @ torch.stack(states) + attention @ torch.stack(news)
    read_BNCVE = read.view(num_chunks, batch, value_heads, chunk, value_dim).permute(1, 0, 3, 2, 4)
    read_BTVE = read_BNCVE.reshape(batch, num_chunks * chunk, value_heads, value_dim)[:, :length]
    return read_BTVE, state.view(batch, value_heads, key_dim, value_dim)


class GatedDelta(Qwen3_5GatedDeltaNet):  # type: ignore[misc]  # transformers is untyped here
    """transformers' layer with its parameter names; whole rows without a cache use :func:`gated_delta_rule`."""

    def forward(
        self, hidden_states: Tensor, cache_params: Any = None, attention_mask: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        """(B, T, H) to (B, T, H), causal; rows may be padded on the right."""
        if cache_params is not None or attention_mask is not None:
            return super().forward(hidden_states, cache_params, attention_mask, **kwargs)
        inputs_BTC, decay, beta, gate = mixers.delta_inputs(self, hidden_states)
        weight = self.conv1d.weight.squeeze(1)
        mixed_BCT = causal_conv1d_fn(inputs_BTC.transpose(1, 2), weight, self.conv1d.bias, activation=self.activation)
        read, _ = gated_delta_rule(
            *mixers.heads(self, mixed_BCT.transpose(1, 2)),
            g=decay,
            beta=beta,
            chunk_size=_GPU_CHUNK if hidden_states.is_cuda else CHUNK,
            use_qk_l2norm_in_kernel=True,
        )
        mixed_BTH: Tensor = self.out_proj(mixers.normed(self, read, gate))
        return mixed_BTH
