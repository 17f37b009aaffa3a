"""PONDER's kernels against their twins: alone at any shape over poisoned memory, and as a whole forward against
``decode``; and which of them a server takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._pytree import tree_leaves

from dual_system.models.graphs import directly
from dual_system.models.kernels.launch import missing_for
from dual_system.models.kernels.trial import MOST_ERROR, Verdict, choose
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.captured import CapturedDecoder
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.kernels.rotate_store import HeadNorms, Projected, Window
from ponder_server.operations import KERNELS, TWINS
from ponder_server.rehearsal import rehearse
from ponder_server.runner import Append, Runner, Session
from ponder_server.slots import Keep, SlotMemory
from ponder_server.stack import Stack

LACK = missing_for(torch.device("cpu"))
interpreted = pytest.mark.skipif(bool(LACK), reason=LACK)
pytestmark = pytest.mark.usefixtures("rounding_interpreter")
few = settings(max_examples=6)
dtypes = st.sampled_from([torch.float32, torch.bfloat16])
seeds = st.integers(0, 2**32 - 1)
NUM_SLOTS = 4
NAN = float("nan")


class Drawing:
    """Numbers of one seed; memory of slots whose invalid part is NaN."""

    def __init__(self, seed: int, dtype: torch.dtype) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.dtype = dtype

    def __call__(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return torch.randn(shape, generator=self.generator).to(dtype or self.dtype)

    def slots(self, num_rows: int) -> Tensor:
        return torch.randperm(NUM_SLOTS, generator=self.generator)[:num_rows]


def check(come: Tensor, expected: Tensor) -> None:
    rtol, atol = (1e-5, 2e-5) if come.dtype == torch.float32 else (2**-5, 2**-4)
    torch.testing.assert_close(come, expected, rtol=rtol, atol=atol, equal_nan=True)


@interpreted
@few
@given(st.integers(1, 3), st.integers(1, 40), st.integers(1, 150), dtypes, seeds)
def test_convolution(num_rows: int, length: int, num_channels: int, dtype: torch.dtype, seed: int) -> None:
    """Also of more tokens than a block has, and of fewer valid ones than the state's width."""
    drawn = Drawing(seed, dtype)
    layers = drawn(NUM_SLOTS, 3, num_channels, 4)  # a layer's states are strided: those of a slot lie side by side
    arguments = drawn(num_rows, length, num_channels), drawn(num_channels, 4)
    slots, num_new = drawn.slots(num_rows), torch.randint(1, length + 1, (num_rows,), generator=drawn.generator)
    num_kept = (torch.rand(num_rows, generator=drawn.generator) * (num_new + 1)).long()
    after = [layers.clone() for _ in range(2)]
    outs = [
        function(*arguments, memory[:, 1], slots, num_new, Keep(memory[:, 2], num_kept))
        for function, memory in zip((KERNELS.conv_silu, TWINS.conv_silu), after, strict=True)
    ]
    check(*outs)
    assert torch.equal(*after), "the states are copied, never computed; other slots and layers are not touched"
    keeps_none = [slot for slot in range(NUM_SLOTS) if slot not in slots[num_kept > 0]]
    assert torch.equal(after[0][keeps_none, 2], layers[keeps_none, 2])


@interpreted
@settings(max_examples=3)
@given(st.integers(1, 3), st.sampled_from([1, 7, 20]), st.sampled_from([(1, 1), (2, 6)]), dtypes, seeds)
def test_recurrence(num_rows: int, length: int, heads: tuple[int, int], dtype: torch.dtype, seed: int) -> None:
    key_heads, num_heads, size = *heads, 16
    drawn = Drawing(seed, dtype)
    num_new = torch.randint(1, length + 1, (num_rows,), generator=drawn.generator)
    mixed = drawn(num_rows, length, (2 * key_heads + num_heads) * size)
    speed_beta = drawn(num_rows, length, 2 * num_heads) * 4.0
    gates = drawn(num_heads, dtype=torch.float32), drawn(num_heads)
    num_kept = (torch.rand(num_rows, generator=drawn.generator) * (num_new + 1)).long()
    memory = drawn(NUM_SLOTS, 3, num_heads, size, size, dtype=torch.float32)
    slots, after = drawn.slots(num_rows), [memory.clone() for _ in range(2)]
    padding = torch.arange(length) >= num_new[:, None]
    reads = []
    for function, states, pad in ((KERNELS.delta, after[0], NAN), (TWINS.delta, after[1], 0.0)):
        padded = [x.masked_fill(padding[..., None], pad) for x in (mixed, speed_beta)]
        reads.append(function(*padded, *gates, states[:, 1], slots, num_new, Keep(states[:, 2], num_kept)))
    assert torch.isfinite(reads[0]).all(), "padding reads zeros"
    check(*(read[~padding] for read in reads))
    torch.testing.assert_close(*after, rtol=1e-4, atol=1e-2 if dtype == torch.bfloat16 else 1e-5)
    untouched = [slot for slot in range(NUM_SLOTS) if slot not in slots]
    assert torch.equal(after[0][untouched], memory[untouched])
    keeps_none = [slot for slot in range(NUM_SLOTS) if slot not in slots[num_kept > 0]]
    assert torch.equal(after[0][keeps_none, 2], memory[keeps_none, 2])
    for row in (num_kept > 0).nonzero().flatten():  # as if these were all
        once = memory.clone()
        TWINS.delta(
            *(x[row, None] for x in (mixed, speed_beta)),
            *gates,
            once[:, 1],
            slots[row, None],
            num_kept[row, None],
            Keep(once[:, 2], torch.zeros(1, dtype=torch.long)),
        )
        # Not bit for bit: the twin's products of one row and of several may add up in another order.
        torch.testing.assert_close(after[1][slots[row], 2], once[slots[row], 1], rtol=1e-4, atol=1e-6)


@interpreted
@few
@given(st.integers(1, 5), st.integers(1, 4), dtypes, seeds)
def test_output_norm_and_gate_of_the_mlp(num_tokens: int, num_heads: int, dtype: torch.dtype, seed: int) -> None:
    drawn = Drawing(seed, dtype)
    read, gate, weight = drawn(num_tokens, num_heads, 32), drawn(num_tokens, num_heads * 32), drawn(32)
    check(*(do.gated_norm(read, gate, weight, 1e-6) for do in (KERNELS, TWINS)))
    check(*(do.swiglu(gate, read.flatten(1)) for do in (KERNELS, TWINS)))


@interpreted
@few
@given(st.integers(1, 3), st.integers(1, 9), st.sampled_from([(1, 1), (6, 2), (4, 4)]), dtypes, seeds)
def test_head_norms_rotation_and_stores(
    num_rows: int, length: int, heads: tuple[int, int], dtype: torch.dtype, seed: int
) -> None:
    num_heads, key_heads, size, positions = *heads, 32, 24
    drawn = Drawing(seed, dtype)
    num_new = torch.randint(1, length + 1, (num_rows,), generator=drawn.generator)
    num_past = positions - num_new - torch.randint(0, 9, (num_rows,), generator=drawn.generator)
    window = Window(drawn.slots(num_rows), num_past, num_new)
    projected = Projected(
        drawn(num_rows, length, num_heads * 2 * size), *(drawn(num_rows, length, key_heads * size) for _ in range(2))
    )
    norms = HeadNorms(drawn(size, dtype=torch.float32), drawn(size, dtype=torch.float32), 1e-6)
    angle = drawn(num_rows, length, 4, dtype=torch.float32).repeat(1, 1, 2)
    cos_sin = angle.cos().to(dtype), angle.sin().to(dtype)
    stored = [[torch.full((NUM_SLOTS, key_heads, positions, size), NAN, dtype=dtype) for _ in "kv"] for _ in "12"]
    queries = [
        do.rotate_store(projected, norms, cos_sin, *memory, window)
        for do, memory in zip((KERNELS, TWINS), stored, strict=True)
    ]
    check(*queries)
    for came, expected in zip(*stored, strict=True):
        check(came, expected)  # NaN where nothing was written
        assert (~came.isnan()).sum() == num_new.sum() * key_heads * size


@interpreted
@settings(max_examples=3)
@given(st.integers(1, 2), st.sampled_from([1, 5, 19]), st.integers(0, 150), st.sampled_from([(1, 1), (6, 2)]), seeds)
def test_attention(num_rows: int, length: int, most_past: int, heads: tuple[int, int], seed: int) -> None:
    """In float32: the interpreter multiplies bfloat16 wrongly."""
    num_heads, key_heads, size, positions = *heads, 16, 176
    drawn = Drawing(seed, torch.float32)
    num_new = torch.randint(1, length + 1, (num_rows,), generator=drawn.generator)
    num_past = torch.randint(0, most_past + 1, (num_rows,), generator=drawn.generator)
    window = Window(drawn.slots(num_rows), num_past, num_new)
    stored = [drawn(NUM_SLOTS, key_heads, positions, size) for _ in "kv"]
    for memory in stored:
        for slot in range(NUM_SLOTS):
            row = (window.slot_B == slot).nonzero().flatten().tolist()
            memory[slot, :, int(num_past[row[0]] + num_new[row[0]]) if row else 0 :] = NAN
    queries, gates = drawn(num_rows, length, num_heads, size), drawn(num_rows, length, num_heads * 2 * size)
    asking = torch.randint(0, length, (num_rows, min(3, length)), generator=drawn.generator).sort().values
    asking = asking.minimum(num_new[:, None] - 1)  # what padding sees differs, and is nobody's
    check(*(do.attend(queries, gates, *stored, asking, window, positions) for do in (KERNELS, TWINS)))


# -- a whole forward


NETWORK = replace(
    tiny_cpu(),
    hidden_size=48,
    ffn_size=64,
    image_px=(32, 32),
    num_layers=4,
    num_query_heads=2,
    num_kv_heads=1,
    num_gdn_key_heads=1,
    num_gdn_value_heads=2,
)


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return Ponder.random(NETWORK, seed=1)


def sessions_of(ponder: Ponder, *, has_kernels: bool) -> list[Session]:
    runner = Runner(ponder, num_slots=2, max_tokens=90, buckets=(1, 4))
    if has_kernels:
        runner.capture(directly, num_read=64)
        assert runner._captured is not None
        runner._captured.operations = lambda num_rows, length: KERNELS  # type: ignore[method-assign]
    return [runner.open(str(index)) for index in range(2)]


def append(ponder: Ponder, sessions: Sequence[Session], sizes: Sequence[int], seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    appends = [
        Append(session=session, ids=[5] * size, embeds_TH=torch.randn(size, ponder.hidden_size, generator=generator))
        for session, size in zip(sessions, sizes, strict=True)
        if size
    ]
    return sessions[0]._runner.append(appends)


@interpreted
@torch.inference_mode()
def test_a_forward_of_kernels_is_the_network_s(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ponder_server.kernels.attention._PROGRAMS", 4)  # an interpreter has one processor
    eager, fused = (sessions_of(ponder, has_kernels=has_kernels) for has_kernels in (False, True))
    for tensor in fused[0]._memory.keys_and_values(slice(None), 90):  # type: ignore[arg-type]
        tensor.fill_(NAN)
    for seed, sizes in enumerate(((6, 3), (0, 4), (1, 1))):
        come, expected = (append(ponder, sessions, sizes, seed) for sessions in (fused, eager))
        for one, other in zip(come, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=2e-4)
    runner = fused[0]._runner
    assert runner._captured is not None
    assert {shape[2] for shape in runner._captured._forwards} == {128}, "one graph serves every number of positions"


# -- which are taken


@pytest.fixture(scope="module")
def samples(ponder: Ponder) -> dict[str, tuple[Any, ...]]:
    memory = SlotMemory(
        ponder.qwen.config.text_config, num_slots=2, max_tokens=64, device=ponder.device, dtype=ponder.dtype
    )
    with torch.inference_mode():
        return rehearse(Stack.of(ponder.qwen.model.language_model), memory, num_rows=2, length=3)


class Timer:
    """Says that a kernel takes ``times[0]`` and its twin ``times[1]``: they are timed in this order."""

    def __init__(self, *times: float) -> None:
        self.times, self.num_calls = times, 0

    def __call__(self, work: Callable[[], object]) -> float:
        work()
        self.num_calls += 1
        return self.times[(self.num_calls - 1) % 2]


def verdict_of(verdicts: list[Verdict], name: str) -> Verdict:
    return next(verdict for verdict in verdicts if verdict.operation == name)


@torch.inference_mode()
def test_what_is_right_and_faster_is_taken_and_nothing_else(samples: dict[str, tuple[Any, ...]]) -> None:
    def wrong(*arguments: Any) -> Any:
        return TWINS.swiglu(*arguments) * (1 + 2 * MOST_ERROR[torch.float32])

    def not_a_number(*arguments: Any) -> Any:
        return TWINS.gated_norm(*arguments) * NAN

    def broken(*arguments: Any) -> Any:
        raise RuntimeError("no kernel image is available")

    def spoils_its_state(*arguments: Any) -> Any:
        out = TWINS.conv_silu(*arguments)
        arguments[2].mul_(2.0)
        return out

    def leaves_no_number_in_memory(*arguments: Any) -> Any:
        out = TWINS.attend(*arguments)
        arguments[3][0] = NAN
        return out

    def own(*arguments: Any) -> Any:
        return TWINS.delta(*arguments)

    mixed = replace(
        TWINS,
        swiglu=wrong,
        gated_norm=not_a_number,
        rotate_store=broken,
        conv_silu=spoils_its_state,
        delta=own,
        attend=leaves_no_number_in_memory,
    )
    chosen, verdicts = choose(samples, TWINS, mixed, Timer(1.0, 2.0))
    assert chosen == replace(TWINS, delta=own)
    assert {verdict.operation for verdict in verdicts if verdict.is_taken} == {"norm", "delta"}
    assert "differs from its twin" in verdict_of(verdicts, "swiglu").why
    assert "differs from its twin by nan" in verdict_of(verdicts, "gated_norm").why
    assert "no kernel image" in verdict_of(verdicts, "rotate_store").why
    slower, verdicts = choose(samples, TWINS, mixed, Timer(2.0, 1.0))
    assert slower == TWINS
    assert not any(verdict.is_taken for verdict in verdicts)


@pytest.mark.parametrize(
    ("untimed", "is_taken", "why"),
    [(0, False, "it cannot be captured: RuntimeError: a"), (1, True, "its twin cannot be captured: RuntimeError: a")],
)
def test_what_cannot_be_captured_loses(
    samples: dict[str, tuple[Any, ...]], untimed: int, is_taken: bool, why: str
) -> None:
    """Servers run it in graphs alone, so it is as useless there as if it did not run."""
    num_timed = 0

    def timer(work: Callable[[], object]) -> float:
        nonlocal num_timed
        num_timed += 1
        if num_timed == 1 + untimed:
            raise RuntimeError("a stream is capturing")
        return 1.0

    _, (verdict,) = choose({"swiglu": samples["swiglu"]}, TWINS, TWINS, timer)
    assert verdict.is_taken is is_taken
    assert verdict.why.startswith(why)


@interpreted
@torch.inference_mode()
def test_the_kernels_themselves_are_right_by_the_server_s_own_measure(
    samples: dict[str, tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ponder_server.kernels.attention._PROGRAMS", 4)
    before = {
        name: [x.clone() for x in tree_leaves(sample) if isinstance(x, Tensor)] for name, sample in samples.items()
    }
    chosen, verdicts = choose(samples, TWINS, KERNELS, Timer(1.0, 2.0))
    assert chosen == replace(KERNELS, quantise=TWINS.quantise, few_rows=TWINS.few_rows), verdicts
    for name, sample in samples.items():
        tensors = [x for x in tree_leaves(sample) if isinstance(x, Tensor)]
        assert all(map(torch.equal, tensors, before[name])), f"trying {name} changes nothing"


@torch.inference_mode()
def test_a_shape_is_tried_once_and_the_memory_is_left_alone(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ponder_server.captured.KERNELS", TWINS)
    memory = SlotMemory(
        ponder.qwen.config.text_config, num_slots=2, max_tokens=64, device=ponder.device, dtype=ponder.dtype
    )
    for tensor in memory.states(1):
        tensor.fill_(7.0)
    timer = Timer(2.0, 1.0)
    captured = CapturedDecoder(ponder.qwen.model.language_model, memory, directly, num_read=4, timer=timer)
    captured.prepare([1], max_rows=2)
    num_calls = timer.num_calls
    captured.prepare([1], max_rows=2)
    assert timer.num_calls == num_calls
    assert all((tensor == 7.0).all() for tensor in memory.states(1))


@pytest.mark.usefixtures("short_warm_up")
def test_a_warm_engine_says_which_kernels_it_took(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ponder_server.captured.KERNELS", replace(TWINS, swiglu=lambda gate, up: gate))
    options = EngineConfig(max_sessions=1, max_context_tokens=512, buckets=(64,), max_batch_rows=1)
    engine = QwenEngine(ponder, options, capture=directly)
    engine._runner.capture(directly, num_read=64, timer=Timer(1.0, 2.0))
    assert engine.spec.kernels == ""
    engine.warm_up()
    assert engine.spec.kernels.startswith("kernels: norm 2/2, swiglu 0/2 (1x16: it differs from its twin by")
    assert engine.spec.kernels.endswith("attend 2/2")
