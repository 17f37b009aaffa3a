"""Every fused operation agrees with its eager twin, on any shape, and touches nothing but its outputs."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.groot.dit import styled_norm
from dual_system.models.groot.qwen3 import PlainRmsNorm
from dual_system.models.kernels import rms_norm
from dual_system.models.kernels.launch import Tolerance, block_size, missing_for
from dual_system.models.pi05.gemma import AdaRmsNorm, GeGlu, GemmaConfig, RmsNorm, Rotation
from dual_system.models.siglip import Float32LayerNorm
from pounce_server.kernels import attention, choice, euler, gate, gate_product, head_rope, rope

LACK = missing_for(torch.device("cpu"))
interpreted = pytest.mark.skipif(bool(LACK), reason=LACK)
pytestmark = pytest.mark.usefixtures("rounding_interpreter")
few = settings(max_examples=12)
dtypes = st.sampled_from([torch.float32, torch.bfloat16])
counts = st.integers(1, 5)
widths = st.integers(1, 41)
seeds = st.integers(0, 2**32 - 1)
GUARD = 67
"""Numbers on either side of a tensor; odd, so that nothing is aligned by luck."""
SENTINEL = 77.0


@dataclass
class Arena:
    """Inputs lie between NaNs: what is read from outside spoils the result. Outputs are NaN, and lie between numbers:
    what is not written shows, and what is written outside, were it NaN.
    """

    seed: int
    dtype: torch.dtype
    storages: list[Tensor] = field(default_factory=list)
    guards: list[Tensor] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def poisoned(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        tensor = self._between(SENTINEL, shape, dtype)
        return tensor.fill_(torch.nan)

    def drawn(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return self._between(torch.nan, shape, dtype).copy_(torch.randn(shape, generator=self.generator))

    def _between(self, guard: float, shape: tuple[int, ...], dtype: torch.dtype | None) -> Tensor:
        count = torch.Size(shape).numel()
        self.storages.append(torch.full((count + 2 * GUARD,), guard, dtype=dtype or self.dtype))
        self.guards.append(self.storages[-1][:GUARD].clone())
        return self.storages[-1][GUARD:-GUARD].view(shape)

    def check_guards(self) -> None:
        for storage, guard in zip(self.storages, self.guards, strict=True):
            for side in (storage[:GUARD], storage[-GUARD:]):
                torch.testing.assert_close(side, guard, rtol=0, atol=0, equal_nan=True)


class Gates(NamedTuple):
    """A gate by its twin, by its kernel, and as the end of a product."""

    eager: gate.Gate
    fused: gate.Gate
    product: Callable[..., None]


GATES = (
    Gates(gate.geglu_eager, gate.geglu_fused, gate_product.geglu_product_fused),
    Gates(gate.swiglu_eager, gate.swiglu_fused, gate_product.swiglu_product_fused),
)


def check(actual: Tensor, expected: Tensor, tolerances: dict[torch.dtype, Tolerance]) -> None:
    tolerance = tolerances[expected.dtype]
    torch.testing.assert_close(actual, expected, rtol=tolerance.rtol, atol=tolerance.atol)


@interpreted
@few
@given(counts, widths, dtypes, st.sampled_from(["no", "plain", "gated"]), st.booleans(), st.booleans(), seeds)
def test_norm(
    rows: int, width: int, dtype: torch.dtype, residual: str, has_shift: bool, is_centred: bool, seed: int
) -> None:
    arena = Arena(seed, dtype)
    x, out = arena.drawn(rows, width), arena.poisoned(rows, width)
    scale, shift, gate = (arena.drawn(width, dtype=torch.float32) for _ in range(3))
    style = rms_norm.Style(scale, shift if has_shift else None, eps=1e-3, is_centred=is_centred)
    branch = rms_norm.Residual(arena.drawn(rows, width), gate if residual == "gated" else None)
    expected_x, expected_out = x.clone(), torch.empty_like(x)
    rms_norm.norm_eager(expected_x, expected_out, style, None if residual == "no" else branch)
    rms_norm.norm_fused(x, out, style, None if residual == "no" else branch)
    check(x, expected_x, rms_norm.TOLERANCE)
    # The norm magnifies what is rounded in a sum near zero, so it is compared over the very sum.
    rms_norm.norm_eager(x.clone(), expected_out, style)
    check(out, expected_out, rms_norm.TOLERANCE)
    arena.check_guards()


@interpreted
@few
@given(counts, widths, dtypes, st.sampled_from(GATES), st.floats(0.1, 60.0), seeds)
def test_gates(rows: int, width: int, dtype: torch.dtype, gates: Gates, spread: float, seed: int) -> None:
    arena = Arena(seed, dtype)
    gate_up, out = arena.drawn(rows, 2 * width), arena.poisoned(rows, width)
    gate_up[:, :width] *= spread
    expected = torch.empty_like(out)
    gates.eager(gate_up, expected)
    gates.fused(gate_up, out)
    check(out, expected, gate.TOLERANCE)
    arena.check_guards()


@interpreted
def test_a_gate_splits_wide_rows_between_programs() -> None:
    arena = Arena(0, torch.float32)
    width = 2 * gate.MAX_BLOCK + 3
    gate_up, out, expected = arena.drawn(2, 2 * width), arena.poisoned(2, width), torch.empty(2, width)
    gate.geglu_eager(gate_up, expected)
    gate.geglu_fused(gate_up, out)
    check(out, expected, gate.TOLERANCE)
    arena.check_guards()


@interpreted
@few
@given(st.integers(1, 2), counts, st.integers(1, 3), st.integers(1, 3), st.integers(1, 9), dtypes, seeds)
def test_rope(batch: int, tokens: int, share: int, kv_heads: int, pairs: int, dtype: torch.dtype, seed: int) -> None:
    arena = Arena(seed, dtype)
    heads, first, slots = share * kv_heads, seed % 4, tokens + 4
    qkv = arena.drawn(batch * tokens, (heads + 2 * kv_heads) * 2 * pairs)
    positions = torch.randint(-9, 900, (batch, tokens), generator=arena.generator)
    rotation = Rotation.at(positions, 2 * pairs)
    results = []
    for run in (rope.rope_eager, rope.rope_fused):
        queries = arena.poisoned(batch, kv_heads, share * tokens, 2 * pairs)
        keys, values = (arena.poisoned(batch, kv_heads, slots, 2 * pairs) for _ in range(2))
        run(qkv, rotation, queries, rope.Slots(keys, values, first))
        for buffer in (keys, values):
            assert buffer[:, :, :first].isnan().all()
            assert buffer[:, :, first + tokens :].isnan().all()
        here = slice(first, first + tokens)
        results.append((queries, keys[:, :, here], values[:, :, here]))
    for expected, actual in zip(*results, strict=True):
        check(actual, expected, rope.TOLERANCE)
    arena.check_guards()


@interpreted
@few
@given(st.integers(1, 2), counts, st.integers(1, 3), st.integers(1, 3), st.integers(1, 9), dtypes, seeds)
def test_head_norms_with_rotation(
    batch: int, tokens: int, share: int, kv_heads: int, pairs: int, dtype: torch.dtype, seed: int
) -> None:
    """In place; the values are left as they are."""
    arena = Arena(seed, dtype)
    heads, size = share * kv_heads, 2 * pairs
    qkv = arena.drawn(batch * tokens, (heads + 2 * kv_heads) * size)
    scales = (arena.drawn(size, dtype=torch.float32) for _ in range(2))
    norms = head_rope.HeadNorms(*scales, heads, kv_heads, 1e-6)
    rotation = Rotation.at(torch.randint(0, 900, (1, tokens), generator=arena.generator), size)
    expected = qkv.clone()
    head_rope.head_rope_eager(expected, norms, rotation)
    before = qkv.clone()
    head_rope.head_rope_fused(qkv, norms, rotation)
    check(qkv, expected, head_rope.TOLERANCE)
    assert torch.equal(qkv[:, (heads + kv_heads) * size :], before[:, (heads + kv_heads) * size :])
    arena.check_guards()


def attended(
    arena: Arena, batch: int, tokens: int, cached: int, heads: tuple[int, int], pairs: int, *, is_missing: bool
) -> None:
    """The kernel's mixed values, keys and values beside the twin's; its slots hold NaN where nothing is visible."""
    share, kv_heads = heads
    first_slot = 3  # those before it belong to another stream
    slots = first_slot + cached + tokens + 1
    qkv = arena.drawn(batch * tokens, (share + 2) * kv_heads * 2 * pairs)
    rotation = Rotation.at(torch.randint(-9, 900, (batch, tokens), generator=arena.generator), 2 * pairs)
    seen = attention.Seen.blank(slice(first_slot, slots - 1), tokens, batch, qkv)
    visible = torch.rand(batch, cached + tokens, generator=arena.generator) < 0.7
    visible[:, -1] = True
    if is_missing:  # a camera
        visible[0, cached // 4 : cached // 4 + 130] = False
    seen.place(visible, tokens)
    memory = [arena.drawn(batch, kv_heads, slots, 2 * pairs) for _ in "kv"]
    results = []
    for run in (attention.attend_eager, attention.attend_fused):
        keys, values = (buffer.clone() for buffer in memory)
        if run is attention.attend_fused:
            is_hidden = torch.ones(batch, slots, dtype=torch.bool)
            is_hidden[:, first_slot : slots - 1] = ~visible
            keys.transpose(1, 2)[is_hidden] = values.transpose(1, 2)[is_hidden] = torch.nan
        mixed = run(rope.rope_eager, qkv, rotation, rope.Slots(keys, values, first_slot + cached), seen)
        own = slice(first_slot + cached, first_slot + cached + tokens)
        results.append((mixed, keys[:, :, own], values[:, :, own]))
        if run is attention.attend_fused:
            assert keys[:, :, :first_slot].isnan().all()
            assert keys[:, :, -1].isnan().all()
    for expected, actual in zip(*results, strict=True):
        check(actual, expected, attention.TOLERANCE)
    arena.check_guards()


@interpreted
@settings(max_examples=4)
@given(
    st.integers(1, 2),
    st.integers(1, 19),
    st.integers(0, 200),
    st.sampled_from([(1, 1), (3, 2), (8, 1)]),
    st.integers(1, 9),
    dtypes,
    st.booleans(),
    seeds,
)
def test_attention_of_few_tokens(
    batch: int,
    tokens: int,
    cached: int,
    heads: tuple[int, int],
    pairs: int,
    dtype: torch.dtype,
    is_missing: bool,
    seed: int,
) -> None:
    """They rotate their own keys, which nobody may read from the slots before."""
    attended(Arena(seed, dtype), batch, tokens, cached, heads, pairs, is_missing=is_missing)


@interpreted
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("cached", [0, 70])
def test_attention_of_many_tokens(dtype: torch.dtype, cached: int) -> None:
    tokens = attention.MOST_ROTATED + 50
    attended(Arena(5, dtype), 1, tokens, cached, (2, 1), 5, is_missing=True)


@interpreted
def test_a_missing_camera_is_not_read() -> None:
    """A block of slots without one that is seen costs nothing: 256 of 848 slots."""
    seen = attention.Seen.blank(slice(0, 868), 20, 1, torch.empty(0))
    visible = torch.ones(1, 868, dtype=torch.bool)
    assert seen.blocks[0].tolist() == [14, *range(14)]
    visible[:, 264:520] = False  # the second of three
    visible[:, 837:848] = False  # the bucket's padding
    seen.place(visible, 20)
    assert seen.blocks[0, :12].tolist() == [11, 0, 1, 2, 3, 4, 8, 9, 10, 11, 12, 13]


@interpreted
@settings(max_examples=8)
@given(st.integers(1, 140), st.integers(1, 70), st.integers(1, 70), dtypes, st.sampled_from(GATES), seeds)
def test_the_product_that_ends_in_its_gate(
    rows: int, inputs: int, width: int, dtype: torch.dtype, gates: Gates, seed: int
) -> None:
    arena = Arena(seed, dtype)
    x, weight, out = arena.drawn(rows, inputs), arena.drawn(2 * width, inputs), arena.poisoned(rows, width)
    weight /= inputs**0.5
    expected = torch.empty_like(out)
    gate_product.gate_product_eager(choice.product, gates.eager, x, weight, expected)
    gates.product(choice.product, gates.fused, x, weight, out)
    check(out, expected, gate_product.TOLERANCE)
    arena.check_guards()


@interpreted
@few
@given(counts, widths, st.integers(1, 16), seeds)
def test_euler(rows: int, width: int, num_steps: int, seed: int) -> None:
    arena = Arena(seed, torch.float32)
    x, velocity, bias = arena.drawn(rows, width), arena.drawn(rows, width), arena.drawn(width)
    expected_x, expected_velocity = x.clone(), velocity.clone()
    euler.euler_eager(expected_x, expected_velocity, bias, num_steps)
    euler.euler_fused(x, velocity, bias, num_steps)
    check(x, expected_x, euler.TOLERANCE)
    check(velocity, expected_velocity, euler.TOLERANCE)
    arena.check_guards()


# -- the twins are what the models do, bit for bit


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@torch.no_grad()
def test_twin_of_the_norm_is_the_model_s(dtype: torch.dtype) -> None:
    arena = Arena(1, dtype)
    x, branch, out = arena.drawn(4, 24), arena.drawn(4, 24), arena.poisoned(4, 24)
    plain = RmsNorm(24)
    plain.weight.copy_(torch.randn(24, generator=arena.generator))
    rms_norm.norm_eager(x, out, rms_norm.Style(1.0 + plain.weight))
    torch.testing.assert_close(out, plain(x), rtol=1e-6, atol=1e-6)

    styled = AdaRmsNorm(24)
    style_3B1E = styled.style(torch.randn(1, 24, generator=arena.generator))
    scale, shift, gate = style_3B1E[:, 0, 0]
    expected_x = x + gate.to(dtype) * branch
    expected, _ = styled(expected_x, style_3B1E[:, 0])
    rms_norm.norm_eager(x, out, rms_norm.Style(scale, shift), rms_norm.Residual(branch, gate))
    assert torch.equal(x, expected_x)
    torch.testing.assert_close(out, expected, rtol=1e-6, atol=1e-6)


@torch.no_grad()
def test_twin_of_the_gate_is_the_model_s() -> None:
    mlp = GeGlu(GemmaConfig(width=6, depth=1, mlp_width=10))
    x, out = torch.randn(3, 6, generator=torch.Generator().manual_seed(0)), torch.empty(3, 10)
    gate.geglu_eager(torch.cat([mlp.gate_proj(x), mlp.up_proj(x)], dim=-1), out)
    torch.testing.assert_close(mlp.down_proj(out), mlp(x))  # not bit for bit on every CPU: strides choose kernels


@torch.no_grad()
def test_twins_of_groot_s_norms_and_heads_are_the_model_s() -> None:
    arena = Arena(2, torch.float32)
    x, out = arena.drawn(4, 24), arena.poisoned(4, 24)
    affine = Float32LayerNorm(24, 1e-5)
    for parameter in (affine.weight, affine.bias):
        parameter.copy_(torch.randn(24, generator=arena.generator))
    rms_norm.norm_eager(x, out, rms_norm.Style(affine.weight, affine.bias, 1e-5, is_centred=True))
    torch.testing.assert_close(out, affine(x), rtol=1e-6, atol=1e-6)
    style_2B1W = torch.randn(2, 1, 1, 24, generator=arena.generator)
    rms_norm.norm_eager(x, out, rms_norm.Style(*style_2B1W[:, 0, 0], 1e-5, is_centred=True))
    torch.testing.assert_close(out, styled_norm(x[None], style_2B1W, 1e-5)[0], rtol=1e-6, atol=1e-6)

    qkv, rotation = arena.drawn(3, 4 * 6), Rotation.at(torch.arange(3)[None], 6)
    query_norm, key_norm = (PlainRmsNorm(6, 1e-6) for _ in range(2))
    for norm in (query_norm, key_norm):
        norm.weight.copy_(torch.randn(6, generator=arena.generator))
    q_1hTD, k_1gTD = (heads[None].transpose(1, 2) for heads in qkv.view(3, 4, 6).split([2, 2], dim=1))
    expected = rotation(query_norm(q_1hTD)), rotation(key_norm(k_1gTD[:, :1]))
    head_rope.head_rope_eager(qkv, head_rope.HeadNorms(query_norm.weight, key_norm.weight, 2, 1, 1e-6), rotation)
    for mine, theirs in zip((qkv[:, :12], qkv[:, 12:18]), expected, strict=True):
        assert torch.equal(mine.view(3, -1, 6).transpose(0, 1), theirs[0])


# -- what does not fit is refused before a pointer is followed


@interpreted
@pytest.mark.parametrize(
    ("out", "message"),
    [
        (torch.empty(3, 4), r"out: expected \(2, 4\) torch.float32 contiguous, came \(3, 4\)"),
        (torch.empty(2, 4, dtype=torch.bfloat16), "came .* torch.bfloat16"),
        (torch.empty(4, 2).T, r"came \(2, 4\) torch.float32 strides \(1, 2\)"),
    ],
)
def test_a_misfit_is_refused(out: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rms_norm.norm_fused(torch.zeros(2, 4), out, rms_norm.Style(torch.ones(4)))


@interpreted
def test_tokens_that_overrun_the_slots_are_refused() -> None:
    keys = torch.zeros(1, 1, 4, 2)
    rotation = Rotation.at(torch.arange(3)[None], 2)
    with pytest.raises(ValueError, match="3 tokens from slot 2 on do not fit into 4 slots"):
        rope.rope_fused(torch.zeros(3, 6), rotation, torch.zeros(1, 1, 3, 2), rope.Slots(keys, keys.clone(), 2))


@given(st.integers(1, 10_000))
def test_block_size_is_the_next_power_of_two(count: int) -> None:
    block = block_size(count)
    assert block & (block - 1) == 0
    assert block // 2 < count <= block


def test_twins_need_no_triton() -> None:
    script = (
        "import sys, torch; sys.modules['triton'] = None\n"
        "from dual_system.models.kernels import launch, rms_norm\n"
        "from pounce_server.kernels import euler, gate, rope\n"
        "gate.geglu_eager(torch.ones(2, 4), torch.empty(2, 2))\n"
        "print(launch.missing_for(torch.device('cuda')))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "Triton is not installed: pip install 'ponderpounce-server[kernels]'"
