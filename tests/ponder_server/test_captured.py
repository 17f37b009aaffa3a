"""Forwards as captured work: what the eager ones give, by operations that depend on no number; memory as they leave it.

Nothing here needs a GPU: the work that a CUDA graph would record is run itself.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from dual_system.models import fp8
from dual_system.models.graphs import Capture, Work, directly
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.captured import CapturedDecoder, position_buckets
from ponder_server.contract import WeightsName
from ponder_server.decoder import Place, decode
from ponder_server.narrow import quantise
from ponder_server.runner import Append, Runner, Session
from ponder_server.slots import SlotMemory

TOLERANCE = 1e-4  # float32, hidden states of size 4
SMALL = replace(tiny_cpu(), hidden_size=48, ffn_size=64, image_px=(32, 32))
NETWORKS = {
    "attention last, heads grouped": replace(SMALL, num_layers=4, num_query_heads=6, num_kv_heads=2),
    "recurrent last, heads alike": replace(SMALL, num_layers=5, num_query_heads=2, num_kv_heads=2),
}
NUM_ROWS = 3
MAX_TOKENS = 90
BUCKETS = (1, 16, 40)


@pytest.fixture(scope="module", params=NETWORKS)
def ponder(request: pytest.FixtureRequest) -> Ponder:
    return Ponder.random(NETWORKS[request.param], seed=1)


def embeds(ponder: Ponder, num_tokens: int, seed: int) -> torch.Tensor:
    return torch.randn(num_tokens, ponder.hidden_size, generator=torch.Generator().manual_seed(seed))


def sessions_of(ponder: Ponder, capture: Capture | None, num_read: int = 64) -> list[Session]:
    runner = Runner(ponder, num_slots=NUM_ROWS, max_tokens=MAX_TOKENS, buckets=BUCKETS)
    if capture is not None:
        runner.capture(capture, num_read=num_read)
        captured_by(runner).position_buckets = (20, 40, MAX_TOKENS)
    return [runner.open(str(index)) for index in range(NUM_ROWS)]


def captured_by(runner: Runner) -> CapturedDecoder:
    assert runner._captured is not None
    return runner._captured


def append(ponder: Ponder, sessions: list[Session], sizes: Sequence[int], wanted: int | None, seed: int) -> Any:
    """Hidden states of the rows that get tokens; the same tokens for the same arguments."""
    appends = [
        Append(
            session=session,
            ids=[5] * size,
            embeds_TH=embeds(ponder, size, seed + index),
            num_wanted=None if wanted is None else min(wanted, size),
        )
        for index, (session, size) in enumerate(zip(sessions, sizes, strict=True))
        if size
    ]
    return sessions[0]._runner.append(appends)


def memory_of(ponder: Ponder) -> SlotMemory:
    text_config = ponder.qwen.config.text_config
    return SlotMemory(text_config, num_slots=4, max_tokens=200, device=ponder.device, dtype=ponder.dtype)


def assert_alike(some: Sequence[torch.Tensor], others: Sequence[torch.Tensor]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=TOLERANCE)


def states(memory: SlotMemory, slot: int) -> list[torch.Tensor]:
    return [tensor.clone() for tensor in memory.states(slot)]


# -- the same numbers


@settings(deadline=None, max_examples=15, derandomize=True)
@given(
    steps=st.lists(st.tuples(*[st.integers(0, 22)] * NUM_ROWS), min_size=1, max_size=4),
    wanted=st.sampled_from([None, 0, 1, 3]),
    astray=st.booleans(),
)
@torch.inference_mode()
def test_rows_of_any_lengths_in_any_pieces_are_what_they_are_without_capture(
    ponder: Ponder, steps: list[tuple[int, ...]], wanted: int | None, astray: bool
) -> None:
    eager, captured = (sessions_of(ponder, capture) for capture in (None, directly))
    for seed, sizes in enumerate(steps):
        assert_alike(*(append(ponder, sessions, sizes, wanted, 9 * seed) for sessions in (captured, eager)))
        if astray:
            saved = captured[0].save()
            captured[0].append([5] * 2, 3.0 * embeds(ponder, 2, 77))
            captured[0].restore(saved)
    for one, other in zip(captured, eager, strict=True):
        assert one.num_tokens == other.num_tokens
        memories = [session._memory for session in (one, other)]
        assert_alike(*(memory.states(one.slot) for memory in memories))
        assert_alike(*(memory.keys_and_values(one.slot, one.num_tokens) for memory in memories))


@torch.inference_mode()
def test_a_slot_can_be_filled_to_its_last_position(ponder: Ponder) -> None:
    """Where the bucket is longer than the room, pads have no place of their own."""
    eager, captured = (sessions_of(ponder, capture) for capture in (None, directly))
    for sizes in ((MAX_TOKENS - 2, 5, 0), (2, 3, 0)):
        assert_alike(*(append(ponder, sessions, sizes, 2, 1) for sessions in (captured, eager)))
    assert captured[0].room == 0


@torch.inference_mode()
def test_nobody_s_garbage_is_read(ponder: Ponder) -> None:
    """What lies past a slot's length, and in other slots, may be anything: also what is no number."""
    clean, dirty = (sessions_of(ponder, directly) for _ in range(2))
    for tensor in dirty[0]._memory.keys_and_values(slice(None), MAX_TOKENS):  # type: ignore[arg-type]
        tensor.fill_(float("nan"))
    for seed, sizes in enumerate(((7, 0, 3), (1, 0, 1), (25, 0, 4), (12, 0, 0))):
        assert_alike(*(append(ponder, sessions, sizes, None, seed) for sessions in (dirty, clean)))


@torch.inference_mode()
def test_one_captured_forward_serves_every_slot_and_every_length(ponder: Ponder) -> None:
    text_model = ponder.qwen.model.language_model
    memory, eager_memory = memory_of(ponder), memory_of(ponder)
    captured = CapturedDecoder(text_model, memory, directly, num_read=16)
    done = Counter[int]()
    for number, (slots, news) in enumerate([((0, 2), (5, 16)), ((2, 1), (1, 9)), ((1, 0), (16, 2)), ((2, 0), (7, 7))]):
        places = [
            Place(slot=slot, num_past=done[slot], num_new=new, num_wanted=min(new, 3 + number))
            for slot, new in zip(slots, news, strict=True)
        ]
        embeds_BTH = embeds(ponder, 32, number).view(2, 16, -1)
        positions_3BT = torch.from_numpy(np.random.default_rng(number).integers(0, 99, (3, 2, 16)))
        for place, row_TH in zip(places, embeds_BTH, strict=True):
            row_TH[place.num_new :] *= 100.0  # pads
        expected = decode(text_model, eager_memory, places, embeds_BTH, positions_3BT)
        assert_alike(captured(places, embeds_BTH, positions_3BT), expected)
        done.update(dict(zip(slots, news, strict=True)))
        assert len(captured) == 1


@torch.inference_mode()
def test_what_was_handed_out_outlives_the_next_forward(ponder: Ponder) -> None:
    """One append may take several forwards of one shape."""
    eager, captured = (sessions_of(ponder, capture) for capture in (None, directly))
    captured_by(captured[0]._runner).position_buckets = (MAX_TOKENS,)
    assert_alike(*(append(ponder, sessions, (80, 0, 0), None, 1) for sessions in (captured, eager)))
    assert len(captured_by(captured[0]._runner)) == 1


@torch.inference_mode()
def test_more_hidden_states_than_a_forward_hands_out_are_had_without_capture(ponder: Ponder) -> None:
    eager, captured = sessions_of(ponder, None), sessions_of(ponder, directly, num_read=4)
    for sizes, wanted, num_graphs in (((9, 3, 0), 4, 1), ((9, 3, 0), 5, 1), ((30, 0, 0), None, 1)):
        assert_alike(*(append(ponder, sessions, sizes, wanted, 3) for sessions in (captured, eager)))
        assert len(captured_by(captured[0]._runner)) == num_graphs


# -- the same operations


SYNCHRONISES = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "is_nonzero", "equal", "lift_fresh")
"""The device's numbers go to the host, or the host's to the device (``torch.tensor``): no graph can hold that."""


class Watch(TorchDispatchMode):
    """Every operation with the shapes of its tensors and all its other arguments; raises where one asks for a number
    or has a shape that depends on numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[str, str]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        assert not name.startswith(SYNCHRONISES), f"{name}: the host waits for the device"
        if name.startswith("index"):
            picked = [x for arg in args if isinstance(arg, list | tuple) for x in arg if isinstance(x, torch.Tensor)]
            assert all(x.dtype != torch.bool for x in picked), "a mask as an index: how many it picks is a number"
        self.operations.append((str(func), repr(_facts([*args, *(kwargs or {}).items()]))))
        return func(*args, **(kwargs or {}))


def _facts(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return tuple(value.shape), value.stride(), value.dtype
    return [_facts(part) for part in value] if isinstance(value, list | tuple) else value


@pytest.mark.parametrize(
    "ask",
    [
        lambda x: x[0].item(),
        lambda x: x.nonzero(),
        lambda x: x[x > 0],
        lambda x: x.masked_select(x > 0),
        lambda x: x.index_put_((x > 0,), x[0]),
        lambda x: 1 if x[0] > 0 else 0,
        lambda x: x + torch.tensor([1.0, 2.0]),
    ],
)
def test_the_watch_sees_whatever_asks_for_a_number(ask: Callable[[torch.Tensor], Any]) -> None:
    with Watch(), pytest.raises(AssertionError):
        ask(torch.ones(2))


@pytest.mark.parametrize("length", [1, 16, 70])
@torch.inference_mode()
def test_no_operation_depends_on_a_number_and_none_waits_for_one(ponder: Ponder, length: int) -> None:
    text_model = ponder.qwen.model.language_model
    forward = CapturedDecoder(text_model, memory_of(ponder), directly, num_read=16).forward(2, length, 200)
    seen = []
    for seed, (slots, past, new) in enumerate([((0, 1), (0, 0), (1, length)), ((3, 1), (97, 9), (length, 1))]):
        places = [
            Place(slot=slot, num_past=before, num_new=more, num_wanted=more % 2)
            for slot, before, more in zip(slots, past, new, strict=True)
        ]
        forward.load(places, embeds(ponder, 2 * length, seed).view(2, length, -1), torch.full((3, 2, length), seed))
        with Watch() as watch:
            forward.run()
        seen.append(watch.operations)
    assert len(seen[0]) > 100
    assert seen[0] == seen[1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("weights", ["float", "fp8"])
@pytest.mark.parametrize("length", [1, 16, 70])
@torch.inference_mode()
def test_it_runs_on_a_device_that_has_no_numbers(
    dtype: torch.dtype, weights: WeightsName, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every choice as on a GPU, fp8 products among them: whatever were read there, or lay elsewhere, would raise."""
    monkeypatch.setattr(fp8, "has_products", lambda device: True)
    ponder = Ponder.random(replace(SMALL, num_layers=4), seed=1, device="meta", dtype=dtype)
    quantise(ponder, weights)
    captured = CapturedDecoder(ponder.qwen.model.language_model, memory_of(ponder), directly, num_read=16)
    places = [Place(slot=slot, num_past=3, num_new=1, num_wanted=1) for slot in range(2)]
    embeds_BTH = torch.zeros(2, length, ponder.hidden_size, device="meta", dtype=dtype)
    with Watch():
        captured.forward(2, length, 200).run()
    hidden = captured(places, embeds_BTH, torch.zeros(3, 2, length, dtype=torch.long))
    assert [(row_NH.shape, row_NH.dtype) for row_NH in hidden] == [((1, ponder.hidden_size), dtype)] * 2


# -- capturing


class Recorder:
    """Captures as a GPU does: runs the work beforehand, on whatever lies in the buffers."""

    def __init__(self) -> None:
        self.num_captured = 0

    def __call__(self, work: Work) -> Work:
        self.num_captured += 1
        for _ in range(3):
            work()
        return work


@torch.inference_mode()
def test_capturing_in_the_middle_of_an_episode_changes_nothing(ponder: Ponder) -> None:
    plain, recorded = sessions_of(ponder, directly), sessions_of(ponder, Recorder())
    assert {session.slot for session in recorded} == {0, 1, 2}
    for seed, sizes in enumerate(((25, 3, 8), (1, 0, 5), (0, 14, 1), (12, 12, 12))):
        outcomes = [append(ponder, sessions, sizes, None, seed) for sessions in (plain, recorded)]
        assert all(map(torch.equal, *outcomes))
    for one, other in zip(plain, recorded, strict=True):
        assert all(map(torch.equal, states(one._memory, one.slot), states(other._memory, other.slot)))


@torch.inference_mode()
def test_a_capture_that_fails_puts_the_memory_back_and_names_the_way_out(ponder: Ponder) -> None:
    def broken(work: Work) -> Work:
        work()
        raise torch.OutOfMemoryError("CUDA out of memory")

    sessions = sessions_of(ponder, None)
    append(ponder, sessions, (9, 9, 9), 1, 0)
    runner = sessions[0]._runner
    before = [states(runner.memory, slot) for slot in range(NUM_ROWS)]
    runner.capture(broken, num_read=4)
    with pytest.raises(RuntimeError, match=r"3 rows of 16 tokens over 128 positions .* --no-graphs"):
        runner.prepare(10, max_rows=8)
    for slot, was in enumerate(before):
        assert all(map(torch.equal, states(runner.memory, slot), was))


@given(max_tokens=st.integers(1, 5000), least=st.integers(1, 1100), num_tokens=st.integers(1, 5000))
def test_attention_computes_at_most_twice_what_is_valid_but_for_short_contexts(
    max_tokens: int, least: int, num_tokens: int
) -> None:
    buckets = position_buckets(max_tokens, least)
    assert list(buckets) == sorted(set(buckets))
    assert max_tokens <= buckets[-1] < max_tokens + 64
    assert buckets[-1] % 64 == 0
    longest = min(num_tokens, max_tokens)
    taken = next(bucket for bucket in buckets if bucket >= longest)
    assert taken < 2 * longest + 64 or taken <= -(-least // 64) * 64, "but for the last bucket's multiple of 64"


def test_the_paper_s_context_has_five_lengths() -> None:
    assert position_buckets(16_384) == (1024, 2048, 4096, 8192, 16_384)


@pytest.mark.parametrize(("num_tokens", "max_rows", "num_graphs"), [(16, 2, 15), (1, 1, 9), (999, 1, 9)])
@torch.inference_mode()
def test_what_is_prepared_is_all_that_can_be_needed(num_tokens: int, max_rows: int, num_graphs: int) -> None:
    """Three numbers of positions; lengths that are shared for as many rows as there may be, the others for one."""
    ponder = Ponder.random(NETWORKS["attention last, heads grouped"], seed=1)
    recorder = Recorder()
    sessions = sessions_of(ponder, recorder)
    runner = sessions[0]._runner
    assert runner.prepare(num_tokens, max_rows=max_rows) == recorder.num_captured == num_graphs
    for size, num_together in product((1, min(num_tokens, 40)), range(1, min(max_rows, NUM_ROWS) + 1)):
        for session in sessions:
            session._runner.memory.clear(session.slot)
            session.ids.clear()
            session.next_position = 0
        for seed in range(MAX_TOKENS // size):
            append(ponder, sessions, [size] * num_together + [0] * (NUM_ROWS - num_together), 1, seed)
    assert recorder.num_captured == num_graphs
